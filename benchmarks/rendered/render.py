"""Ray-cast pictures (Embree): one light with shadows, a bright sky and floor, textures, hair cut out by its alpha."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from ahoy_core.texture.rays import to_camera
from benchmarks.rendered.people import Person
from benchmarks.rendered.rooms import Box, mesh

FloatArray = NDArray[np.float64]
LAYERS = 4  # strands that a ray may pass through
OPAQUE = 100  # of 255
COLUMNS = 256
EXPOSURE = 1.15
LIFT = 2e-3  # metres that shadow rays start off the surface


@dataclass(frozen=True)
class View:
    """A camera and a light.

    Attributes:
        viewmat: [4,4] world -> camera.
        K: [3,3] pixels.
        height: of the picture.
        width: of the picture.
        fine: rays along a pixel's side.
        light: [3] unit vector towards the light, world.
        ambient: share of the light that comes from everywhere.
    """

    viewmat: FloatArray
    K: FloatArray
    height: int
    width: int
    fine: float
    light: FloatArray
    ambient: float


@dataclass(frozen=True)
class Picture:
    """rgb [H,W,3] uint8; visible, amodal [H,W] uint8 alpha of the person seen and whole."""

    rgb: NDArray[np.uint8]
    visible: NDArray[np.uint8]
    amodal: NDArray[np.uint8]


@dataclass(frozen=True)
class _Mesh:
    vertices: FloatArray
    tints: FloatArray
    faces: NDArray[np.int64]
    uvs: FloatArray
    skin: NDArray[np.int64]  # [F] which texture
    textures: list[NDArray[np.uint8]]
    cuts: list[bool]

    @cached_property
    def embree(self) -> tuple[EmbreeScene, TriangleMesh]:
        """What rays are cast into; the second keeps the triangles alive."""
        scene = EmbreeScene()
        return scene, TriangleMesh(scene, self.vertices.astype(np.float32), self.faces.astype(np.int32))


def render(people: list[tuple[Person, list[FloatArray]]], boxes: list[Box], view: View, subject: int = 0) -> Picture:
    """Draw people (each with its posed parts) among boxes; masks are of one of them."""
    parts = [part for who, posed in people for part in _parts(who, posed)]
    owner = [number for number, (who, _) in enumerate(people) for _ in who.parts] + [-1] * len(boxes)
    whole = _join(parts + _furniture(boxes), view)
    mine = [i for i, number in enumerate(owner) if number == subject]
    alone = _join([parts[i] for i in mine], view)
    rays = _rays(view)
    hit, bary, _ = _first_hits(whole, rays)
    rgb = _shade(whole, view, hit, bary, rays)
    visible = (hit >= 0) & np.isin(whole.skin[np.maximum(hit, 0)], mine)
    amodal = _first_hits(alone, rays)[0] >= 0
    return Picture(*(_shrink(image, view) for image in (rgb, 255.0 * visible, 255.0 * amodal)))


def render_alone(person: Person, posed: list[FloatArray], boxes: list[Box], view: View) -> NDArray[np.uint8]:
    """The person without what stands before and behind, which still throws its shadows.

    Returns:
        [H,W,4] RGBA with straight alpha; black where alpha is 0.
    """
    mine = _parts(person, posed)
    whole, rays = _join(mine + _furniture(boxes), view), _rays(view)
    hit, bary, _ = _first_hits(_join(mine, view), rays)  # the person comes first: triangles keep their numbers
    alpha = (hit >= 0).astype(np.float64)
    rgb = np.clip(_shade(whole, view, hit, bary, rays), 0, 255) * alpha[:, None]
    share = _reduce(alpha, view)
    straight = _reduce(rgb, view) / np.maximum(share, 1e-6)[..., None]
    rgba = np.concatenate([straight, 255 * share[..., None]], axis=2)
    return np.where(rgba[..., 3:] >= 0.5, np.round(rgba), 0).astype(np.uint8)


def _parts(who: Person, posed: list[FloatArray]) -> list[tuple]:  # type: ignore[type-arg]
    return [(p.faces, v, p.uvs, p.texture, p.tint, p.cut) for p, v in zip(who.parts, posed, strict=True)]


def _furniture(boxes: list[Box]) -> list[tuple]:  # type: ignore[type-arg]
    parts = []
    for item in boxes:
        vertices, faces, uvs = mesh(item)
        parts.append((faces, vertices, uvs, item.texture, np.ones((8, 3)), False))
    return parts


def _join(parts: list, view: View) -> _Mesh:  # type: ignore[type-arg]
    offsets = np.cumsum([0] + [len(part[1]) for part in parts])
    vertices = np.concatenate([part[1] for part in parts])
    return _Mesh(
        to_camera(vertices, view.viewmat),
        np.concatenate([part[4] for part in parts]),
        np.concatenate([part[0] + offset for part, offset in zip(parts, offsets, strict=False)]),
        np.concatenate([part[2] for part in parts]),
        np.repeat(np.arange(len(parts)), [len(part[0]) for part in parts]),
        [part[3] for part in parts],
        [part[5] for part in parts],
    )


def _rays(view: View) -> NDArray[np.float32]:
    """Unit directions [N,3] in camera axes, row by row."""
    h, w = round(view.height * view.fine), round(view.width * view.fine)
    rows, columns = np.mgrid[:h, :w]
    pixels = np.stack([(columns.ravel() + 0.5) / view.fine, (rows.ravel() + 0.5) / view.fine, np.ones(h * w)], axis=1)
    through = pixels @ np.linalg.inv(view.K).T
    return (through / np.linalg.norm(through, axis=1, keepdims=True)).astype(np.float32)


def _first_hits(scene_mesh: _Mesh, rays: NDArray[np.float32]) -> tuple[NDArray[np.int64], FloatArray, FloatArray]:
    """Triangle [N] (-1: none), corner shares [N,3] and distance [N]; strands whose alpha is low are passed through."""
    scene = scene_mesh.embree[0]
    face = np.full(len(rays), -1, np.int64)
    bary, far = np.zeros((len(rays), 3)), np.full(len(rays), np.inf)
    start = np.zeros(len(rays))
    alive = np.arange(len(rays))
    for _ in range(LAYERS):
        origins = (rays[alive] * start[alive, None]).astype(np.float32)
        found = scene.run(origins, rays[alive], output=1)
        met = found["primID"] >= 0
        alive, ids = alive[met], found["primID"][met].astype(np.int64)
        u, v, t = (found[key][met].astype(np.float64) for key in ("u", "v", "tfar"))
        face[alive], far[alive] = ids, start[alive] + t
        bary[alive] = np.stack([1 - u - v, u, v], axis=1)
        through = np.zeros(len(alive), np.bool_)
        for number, cut in enumerate(scene_mesh.cuts):
            rows = np.flatnonzero(scene_mesh.skin[ids] == number) if cut else np.empty(0, np.int64)
            if len(rows):
                through[rows] = _look_up(scene_mesh, ids[rows], bary[alive[rows]], number)[:, 3] < OPAQUE
        face[alive[through]] = -1
        start[alive[through]] = far[alive[through]] + 1e-4
        alive = alive[through]
        if not len(alive):
            break
    return face, bary, far


def _look_up(scene_mesh: _Mesh, ids: NDArray[np.int64], bary: FloatArray, number: int) -> FloatArray:
    texture = scene_mesh.textures[number]
    size = np.array(texture.shape[1::-1])
    uv = np.einsum("nk,nkc->nc", bary, scene_mesh.uvs[ids])
    place = ((np.stack([uv[:, 0], 1 - uv[:, 1]], 1) % 1.0) * size - 0.5).astype(np.float32)
    # OpenCV takes at most 32,767 rows, so the places are laid out in columns.
    grid = np.zeros((-(-len(place) // COLUMNS) * COLUMNS, 2), np.float32)
    grid[: len(place)] = place
    x, y = grid.reshape(-1, COLUMNS, 2).transpose(2, 0, 1)
    flat = cv2.remap(
        texture, np.ascontiguousarray(x), np.ascontiguousarray(y), cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP
    )
    return np.asarray(flat.reshape(-1, 4)[: len(place)], np.float64)


def _shade(
    scene_mesh: _Mesh, view: View, face: NDArray[np.int64], bary: FloatArray, rays: NDArray[np.float32]
) -> FloatArray:
    colour = np.full((len(face), 3), 60.0)
    hit = np.flatnonzero(face >= 0)
    ids, share = face[hit], bary[hit]
    corners = scene_mesh.faces[ids]
    albedo = np.einsum("nk,nkc->nc", share, scene_mesh.tints[corners])
    for number in np.unique(scene_mesh.skin[ids]):
        rows = np.flatnonzero(scene_mesh.skin[ids] == number)
        albedo[rows] *= _look_up(scene_mesh, ids[rows], share[rows], number)[:, :3]
    normals = np.einsum("nk,nkc->nc", share, _normals(scene_mesh)[corners])
    flat = np.cross(scene_mesh.vertices[corners[:, 1]] - scene_mesh.vertices[corners[:, 0]],
                    scene_mesh.vertices[corners[:, 2]] - scene_mesh.vertices[corners[:, 0]])  # fmt: skip
    sharp = scene_mesh.skin[ids] >= len(scene_mesh.cuts) - _boxes(scene_mesh)
    normals[sharp] = flat[sharp]
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    normals *= -np.sign((normals * rays[hit]).sum(1, keepdims=True))
    points = np.einsum("nk,nkc->nc", share, scene_mesh.vertices[corners])
    light = view.viewmat[:3, :3] @ view.light
    facing = np.clip(normals @ light, 0, 1)
    scene = scene_mesh.embree[0]
    origins = (points + LIFT * normals).astype(np.float32)
    lit = scene.run(origins, np.broadcast_to(light, origins.shape).astype(np.float32), query="OCCLUDED") != 0
    up = normals @ view.viewmat[:3, 2]
    strength = view.ambient * (0.85 + 0.15 * up) + (1.05 - view.ambient) * facing * np.where(lit, 1.0, 0.25)
    colour[hit] = EXPOSURE * albedo * strength[:, None]
    return colour


def _boxes(scene_mesh: _Mesh) -> int:
    """How many of the last textures are boxes': those with eight vertices each (12 triangles)."""
    counts = np.bincount(scene_mesh.skin, minlength=len(scene_mesh.cuts))
    return int((counts[::-1] != 12).argmax()) if (counts != 12).any() else len(counts)


def _normals(scene_mesh: _Mesh) -> FloatArray:
    a, b, c = (scene_mesh.vertices[scene_mesh.faces[:, i]] for i in range(3))
    flat = np.cross(b - a, c - a)
    normals = np.zeros_like(scene_mesh.vertices)
    for column in range(3):
        for k in range(3):
            normals[:, k] += np.bincount(scene_mesh.faces[:, column], flat[:, k], minlength=len(normals))
    return normals


def _shrink(values: FloatArray, view: View) -> NDArray[np.uint8]:
    return np.round(_reduce(np.clip(values, 0, 255), view)).astype(np.uint8)


def _reduce(values: FloatArray, view: View) -> FloatArray:
    """Values [N,...] of rays to means [H,W,...] over pixels."""
    h, w = round(view.height * view.fine), round(view.width * view.fine)
    image = values.reshape(h, w, *values.shape[1:]).astype(np.float32)
    return np.asarray(cv2.resize(image, (view.width, view.height), interpolation=cv2.INTER_AREA), np.float64)
