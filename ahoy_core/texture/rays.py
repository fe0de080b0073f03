"""Rays against triangles (Embree): which point of the body does a pixel see, and is a point of the body seen?

Everything is cast in camera coordinates (OpenCV axes): a person kilometres from the origin loses no precision in
Embree's float32.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from ahoy_core.conventions import CameraModel

# Names for the reader; docstrings give the precise dtypes, which numpy's stubs lose at the first operation.
FloatArray = NDArray[Any]
IntArray = NDArray[Any]
BoolArray = NDArray[Any]


# A texel's point lies on the mesh, so its own ray meets the mesh there up to float32 rounding; a neighbouring face
# hit at a shared edge is within a fraction of a millimetre. Two layers of a body are never this close and both facing
# the camera.
SAME_SURFACE = 2e-3


@dataclass(frozen=True)
class Hits:
    """First hits of N rays.

    face [N] int32 (-1: a miss), bary [N,3] weights of the face's corners, distance [N] metres (inf: a miss).
    """

    face: IntArray
    bary: FloatArray
    distance: FloatArray


@dataclass(frozen=True)
class HitMap:
    """First hits of an image's pixels.

    face [H,W] int32 (-1: the body is not there), bary [H,W,3] float32, depth [H,W] float32 (camera z in metres, inf
    where missed), cosine [H,W] float32 (outward normal against the direction to the camera, 0 where missed, negative
    on the mesh's inside).
    """

    face: IntArray
    bary: FloatArray
    depth: FloatArray
    cosine: FloatArray


class Caster:
    """A triangle mesh in camera coordinates, ready for rays.

    Args:
        vertices: [V,3] camera coordinates, metres.
        faces: [F,3] vertex indices, counter-clockwise seen from outside.
        camera_model: "pinhole" (rays start at the origin) or "ortho" (rays run along +z).

    Attributes:
        normals: [F,3] outward unit normals, camera coordinates.
    """

    def __init__(self, vertices: FloatArray, faces: IntArray, camera_model: CameraModel = "pinhole") -> None:
        if not np.isfinite(vertices).all():
            raise ValueError("expected finite vertices, got NaN or infinity: leave this frame out (used = False)")
        self.vertices = np.ascontiguousarray(vertices, dtype=np.float32)
        self.faces = np.ascontiguousarray(faces, dtype=np.int32)
        self.camera_model = camera_model
        self._near = float(self.vertices[:, 2].min()) - 1.0
        self._scene = EmbreeScene()
        self._mesh = TriangleMesh(self._scene, self.vertices, self.faces)
        self.normals = face_normals(self.vertices, self.faces)

    def rays(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Origins and unit directions [N,3] of the camera's rays through points [N,3] (camera coordinates)."""
        points = np.asarray(points, dtype=np.float32)
        if self.camera_model == "ortho":
            origins = points.copy()
            origins[:, 2] = self._near
            directions = np.broadcast_to(np.array([0, 0, 1], dtype=np.float32), points.shape)
        else:
            origins = np.zeros_like(points)
            directions = points / np.maximum(np.linalg.norm(points, axis=1, keepdims=True), 1e-12)
        return origins, np.ascontiguousarray(directions, dtype=np.float32)

    def cast(self, points: FloatArray) -> Hits:
        """First hits of the camera's rays through points [N,3] (camera coordinates)."""
        origins, directions = self.rays(points)
        if len(origins) == 0:
            return Hits(np.empty(0, np.int32), np.empty((0, 3), np.float32), np.empty(0, np.float32))
        found = self._scene.run(origins, directions, output=1)
        face = found["primID"]
        u, v = found["u"], found["v"]
        distance = np.where(face >= 0, found["tfar"], np.float32(np.inf))
        return Hits(face, np.stack([1 - u - v, u, v], axis=1), distance)

    def sees(self, points: FloatArray, face: IntArray) -> BoolArray:
        """Whether nothing stands before points [N,3], given as lying on the faces [N]."""
        origins, directions = self.rays(points)
        hits = self.cast(points)
        own = ((np.asarray(points, np.float32) - origins) * directions).sum(axis=1)
        return (hits.face == face) | (hits.distance >= own - SAME_SURFACE)


def to_camera(points: FloatArray, viewmat: FloatArray) -> FloatArray:
    """World points [N,3] in camera coordinates, float64."""
    view = np.asarray(viewmat, dtype=np.float64)
    return np.asarray(points, dtype=np.float64) @ view[:3, :3].T + view[:3, 3]


def to_pixels(points: FloatArray, K: FloatArray, camera_model: CameraModel = "pinhole") -> FloatArray:
    """Camera points [N,3] in pixels [N,2] (centres at +0.5); points at or behind a pinhole become NaN."""
    xy = points[:, :2]
    if camera_model == "pinhole":
        z = np.where(points[:, 2:3] > 1e-6, points[:, 2:3], np.nan)
        xy = xy / z
    return xy @ np.asarray(K, dtype=np.float64)[:2, :2].T + np.asarray(K, dtype=np.float64)[:2, 2]


def face_normals(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """Unit outward normals [F,3]; zero for a degenerate face."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    return normal / np.maximum(length, 1e-20)


def view_cosines(points: FloatArray, normals: FloatArray, camera_model: CameraModel) -> FloatArray:
    """Cosine [N] between outward normals [N,3] and the way from points [N,3] to the camera (camera coordinates)."""
    if camera_model == "ortho":
        return -normals[:, 2]
    towards = -points / np.maximum(np.linalg.norm(points, axis=1, keepdims=True), 1e-12)
    return (normals * towards).sum(axis=1)


def hit_map(caster: Caster, K: FloatArray, width: int, height: int) -> HitMap:
    """First hit of every pixel's centre.

    Args:
        caster: the mesh in camera coordinates.
        K: [3,3] pixels.
        width: pixels.
        height: pixels.
    """
    face = np.full((height, width), -1, dtype=np.int32)
    bary = np.zeros((height, width, 3), dtype=np.float32)
    depth = np.full((height, width), np.inf, dtype=np.float32)
    cosine = np.zeros((height, width), dtype=np.float32)
    box = _pixel_box(caster, K, width, height)
    if box is not None:
        x0, y0, x1, y1 = box
        rows, cols = np.mgrid[y0:y1, x0:x1]
        pixels = np.stack([cols.ravel() + 0.5, rows.ravel() + 0.5, np.ones(rows.size)], axis=1)
        through = pixels @ np.linalg.inv(np.asarray(K, dtype=np.float64)).T
        hits = caster.cast(through)
        hit = hits.face >= 0
        where = rows.ravel()[hit], cols.ravel()[hit]
        corners = caster.vertices[caster.faces[hits.face[hit]]]
        points = (corners * hits.bary[hit, :, None]).sum(axis=1)
        normals = caster.normals[hits.face[hit]]
        face[where], bary[where], depth[where] = hits.face[hit], hits.bary[hit], points[:, 2]
        cosine[where] = view_cosines(points, normals, caster.camera_model)
    return HitMap(face, bary, depth, cosine)


def _pixel_box(caster: Caster, K: FloatArray, width: int, height: int) -> tuple[int, int, int, int] | None:
    """Pixels x0, y0, x1, y1 that the mesh can touch: the whole image where a vertex is behind a pinhole."""
    pixels = to_pixels(caster.vertices.astype(np.float64), K, caster.camera_model)
    if np.isnan(pixels).all():
        return None
    if np.isnan(pixels).any():
        return 0, 0, width, height
    # Clipped before the cast to int: a vertex grazing the camera plane may project beyond the range of int64.
    low = np.clip(np.floor(pixels.min(axis=0)), 0, (width, height)).astype(int)
    high = np.clip(np.ceil(pixels.max(axis=0)), 0, (width, height)).astype(int)
    if (high <= low).any():
        return None
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])
