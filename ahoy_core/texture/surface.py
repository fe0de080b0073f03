"""Role "surface" (paper section 3.1): which point of the body's surface does each visible pixel show?

The paper asks DensePose; here the fitted body is ray-cast and its answer kept where the mask of the visible person
agrees, the surface is not seen at a grazing angle, and no boundary is near: there, a fit that is off by a few pixels
would take the background's colour, or the arm's for the chest's.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ahoy_core.body.model import BodyModel
from ahoy_core.conventions import CameraModel
from ahoy_core.texture.rays import BoolArray, Caster, FloatArray, HitMap, IntArray, hit_map, to_camera

# Limbs of a body's vertices, by the joint that moves them most.
TRUNK, ARM, LEG = 0, 1, 2
# What joints of arms and legs are called: the packaged body, the SMPL family, and plain words.
_ARM_WORDS = ("arm", "elbow", "wrist", "finger", "metacarpal", "hand", "thumb", "index", "middle", "ring", "pinky")
_ARM_NAMES = ("left_shoulder", "right_shoulder")
_LEG_WORDS = ("leg", "knee", "ankle", "foot", "toe", "hip")

PARTS = ("background", "body", "head", "hands", "feet")

# Height in pixels of the body at which `boundary_px` is meant literally: fits err by a share of the person's size,
# not by pixels.
REFERENCE_HEIGHT = 200.0
# Two neighbouring pixels this far apart in depth (metres) belong to different layers: an arm before the chest, a leg
# before a leg.
LAYER_GAP = 0.04
HALF_ALPHA = 128


@dataclass(frozen=True)
class Surface:
    """The body's triangles, as arrays.

    faces [F,3] into vertices, uvs [Vt,2] in [0,1] (origin lower left), uv_faces [F,3] into uvs, textured [F] bool
    (False: mouth, eye sockets), part [F] uint8 into `PARTS`, hands / head / feet [V] bool, limb [V] uint8 (`TRUNK`,
    `ARM` or `LEG`).
    """

    faces: IntArray
    uvs: FloatArray
    uv_faces: IntArray
    textured: BoolArray
    part: IntArray
    hands: BoolArray
    head: BoolArray
    feet: BoolArray
    limb: IntArray

    @staticmethod
    def of(body: BodyModel) -> Surface:
        """The surface of a body model."""
        faces = body.faces.cpu().numpy().astype(np.int32)
        count = max(int(faces.max()) + 1, *(len(mask) for mask in body.regions.values()), 0)
        nowhere = np.zeros(count, dtype=bool)
        regions = {name: mask.cpu().numpy().astype(bool) for name, mask in body.regions.items()}
        part = np.ones(len(faces), dtype=np.uint8)
        for number, name in enumerate(PARTS[2:], start=2):
            part[regions.get(name, nowhere)[faces].all(axis=1)] = number
        return Surface(
            faces=faces,
            uvs=body.uvs.cpu().numpy().astype(np.float32),
            uv_faces=body.uv_faces.cpu().numpy().astype(np.int32),
            textured=np.logical_not(regions.get("interior", nowhere)[faces].all(axis=1)),
            part=part,
            hands=regions.get("hands", nowhere),
            head=regions.get("head", nowhere),
            feet=regions.get("feet", nowhere),
            limb=_limbs(body),
        )


def _limbs(body: BodyModel) -> IntArray:
    """[V] the limb of each vertex."""
    limb_of = np.zeros(body.n_joints, dtype=np.uint8)
    for joint, name in enumerate(body.joint_names):
        if name in _ARM_NAMES or any(word in name for word in _ARM_WORDS):
            limb_of[joint] = ARM
        elif any(word in name for word in _LEG_WORDS):
            limb_of[joint] = LEG
    limbs: IntArray = limb_of[body.lbs_weights.cpu().numpy().argmax(axis=1)]
    return limbs


@dataclass(frozen=True)
class SeenFrame:
    """One frame looked at through the fitted body: the caster, K [3,3], and per pixel hits, validity and margin.

    valid [H,W]: this pixel's colour may be trusted to be the surface's. margin [H,W] float32: pixels to the nearest
    boundary (mask or layer), in units of the boundary that was asked for, so that 1 is just trusted.
    """

    caster: Caster
    K: FloatArray
    hits: HitMap
    valid: BoolArray
    margin: FloatArray


def look(
    surface: Surface,
    vertices: FloatArray,
    viewmat: FloatArray,
    K: FloatArray,
    visible: IntArray,
    *,
    grazing_cos: float = 0.3,
    boundary_px: float = 2.0,
    camera_model: CameraModel = "pinhole",
) -> SeenFrame:
    """Cast a frame's pixels against the posed body and decide which to trust.

    Args:
        surface: the body's triangles.
        vertices: [V,3] posed, world, metres.
        viewmat: [4,4] world -> camera.
        K: [3,3] pixels.
        visible: [H,W] uint8 alpha of the visible part of the person.
        grazing_cos: smallest cosine between the surface's normal and the view that is trusted, in (0,1).
        boundary_px: pixels next to the mask's edge, or to an edge between two layers of the body, that are not
            trusted, for a body 200 pixels tall; scales with the body's height in the frame.
        camera_model: "pinhole" or "ortho".
    """
    caster = Caster(to_camera(vertices, viewmat), surface.faces, camera_model)
    return trust(surface, caster, K, visible, grazing_cos, boundary_px)


def trust(
    surface: Surface, caster: Caster, K: FloatArray, visible: IntArray, grazing_cos: float, boundary_px: float
) -> SeenFrame:
    """`look` with a body that stands in the camera's coordinates already."""
    height, width = visible.shape
    hits = hit_map(caster, K, width, height)
    boundary = boundary_px * height_in_pixels(hits) / REFERENCE_HEIGHT
    inside = _distance_inside((visible >= HALF_ALPHA) & ~_layer_edges(hits.depth))
    trusted = (hits.face >= 0) & surface.textured[hits.face] & (hits.cosine >= grazing_cos)
    margin = inside / max(boundary, 1e-6)
    return SeenFrame(caster, K, hits, trusted & (inside > 0) & (inside >= boundary), margin.astype(np.float32))


def height_in_pixels(hits: HitMap) -> float:
    """Rows that the body spans in the image, 0 where it is not in it."""
    rows = np.flatnonzero((hits.face >= 0).any(axis=1))
    return float(rows[-1] - rows[0] + 1) if len(rows) else 0.0


def _layer_edges(depth: FloatArray) -> BoolArray:
    """Pixels [H,W] that touch a jump in depth between two layers of the body (not between body and nothing)."""
    edges = np.zeros(depth.shape, dtype=bool)
    finite = np.where(np.isfinite(depth), depth, np.nan)
    with np.errstate(invalid="ignore"):
        across = np.abs(np.diff(finite, axis=1)) > LAYER_GAP
        down = np.abs(np.diff(finite, axis=0)) > LAYER_GAP
    edges[:, 1:] |= across
    edges[:, :-1] |= across
    edges[1:] |= down
    edges[:-1] |= down
    return edges


def _distance_inside(mask: BoolArray) -> FloatArray:
    """Pixels [H,W] from each pixel's centre to the mask's nearest edge, 0 outside; the image's border is no edge."""
    if mask.all():
        return np.full(mask.shape, np.float32(max(mask.shape)))
    # OpenCV measures to the nearest outside pixel's centre, half a pixel beyond the edge.
    distance: FloatArray = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.maximum(distance - 0.5, 0)


@dataclass(frozen=True)
class Correspondences:
    """Of T frames: part [T,H,W] uint8 into `PARTS`, uv [T,2,H,W] float32 in [0,1], NaN where part is 0."""

    part: IntArray
    uv: FloatArray


def correspondences(
    surface: Surface,
    vertices: FloatArray,
    viewmat: FloatArray,
    K: FloatArray,
    visible: IntArray,
    *,
    grazing_cos: float = 0.3,
    boundary_px: float = 2.0,
) -> Correspondences:
    """The surface role's contract: part and UV of each visible pixel.

    Args:
        surface: the body's triangles.
        vertices: [T,V,3] posed, world, metres.
        viewmat: [4,4] world -> camera.
        K: [3,3] pixels.
        visible: [T,H,W] uint8 alpha of the visible part of the person.
        grazing_cos: see `look`.
        boundary_px: see `look`.
    """
    frames, height, width = visible.shape
    part = np.zeros((frames, height, width), dtype=np.uint8)
    uv = np.full((frames, 2, height, width), np.nan, dtype=np.float32)
    for t in range(frames):
        seen = look(surface, vertices[t], viewmat, K, visible[t], grazing_cos=grazing_cos, boundary_px=boundary_px)
        face = seen.hits.face[seen.valid]
        part[t][seen.valid] = surface.part[face]
        uv[t][:, seen.valid] = interpolate_uv(surface, face, seen.hits.bary[seen.valid]).T
    return Correspondences(part, uv)


def interpolate_uv(surface: Surface, face: IntArray, bary: FloatArray) -> FloatArray:
    """UV [N,2] of points given by face [N] and barycentric weights [N,3]."""
    return (surface.uvs[surface.uv_faces[face]] * bary[:, :, None]).sum(axis=1)
