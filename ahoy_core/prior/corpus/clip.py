"""One clip of the corpus: a person, an action, eight cameras; geometry once, colours several times."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ahoy_core.body.lbs import forward_kinematics, lbs
from ahoy_core.body.packaged import PackagedBody
from ahoy_core.conventions import GREY, PERSON_HEIGHT_SHARE, CameraModel, Cameras, look_at, orbit_eyes
from ahoy_core.prior.bodymaps import body_maps
from ahoy_core.prior.corpus.coarse import View, coarse_frames, random_occluder
from ahoy_core.prior.corpus.dress import KINDS, Dressed, vertex_normals
from ahoy_core.prior.corpus.paint import has_print, random_paint
from ahoy_core.prior.corpus.poses import ACTIONS, HELD_OUT_ACTIONS, Action, action_rotations
from ahoy_core.prior.corpus.prompts import WEARABLES, caption
from ahoy_core.prior.corpus.shade import Light, Surface, shade, surface
from ahoy_core.prior.corpus.wardrobe import Split
from ahoy_core.prior.framing import HEIGHT, WIDTH, framing_Ks
from ahoy_core.prior.raster import Hits, rasterize

Array = NDArray[Any]

FRAMES: Final = 8
SAMPLES: Final = 2  # along each axis of a pixel
BACKGROUND_PART: Final = 255


@dataclass(frozen=True, eq=False)
class Clip:
    """T frames of H x W.

    Attributes:
        image: [T,H,W,3] uint8 over grey.
        mask: [T,H,W] uint8 alpha.
        part: [T,H,W] uint8 index into `KINDS`, 255 outside.
        coarse: [T,H,W,3] uint8, what a coarse avatar of frame 0 (and perhaps 1) would look like.
        coverage: [T,H,W] uint8, 255 where the surface was observed.
        body: [T,7,H/4,W/4] int8, `body_maps` times 127.
        azimuth: [T] float32 radians.
        observed: [T] uint8, 1 for frames that the imagined video showed.
        prompt: caption.
        back_print: there is a print on the back, which no front tells of.
    """

    image: Array
    mask: Array
    part: Array
    coarse: Array
    coverage: Array
    body: Array
    azimuth: Array
    observed: Array
    prompt: str
    back_print: bool


@dataclass(frozen=True, eq=False)
class Scene:
    """Geometry of a clip: everything that colours do not change."""

    person: Dressed
    surfaces: list[Surface]
    hits: list[Hits]
    screens: Array
    cameras: Cameras
    body: Array
    azimuth: Array


def random_scene(rng: np.random.Generator, body: PackagedBody, person: Dressed, split: Split) -> Scene:
    """Poses a person, places eight cameras and finds what every pixel sees."""
    held_out = split == "motion"
    actions: tuple[Action, ...] = HELD_OUT_ACTIONS if held_out else tuple(ACTIONS)
    action = actions[int(rng.choice(len(actions), p=None if held_out else list(ACTIONS.values())))]
    moving = bool(rng.random() < 0.25)
    rotations = action_rotations(body, rng, action, FRAMES if moving else 1)
    vertices, bare = _posed(body, person, rotations)
    azimuth = _azimuths(rng, turning=not moving or bool(rng.random() < 0.4))
    cameras = _framed(rng, bare, azimuth)
    frames = [0] * FRAMES if len(vertices) == 1 else list(range(FRAMES))
    projected = cameras.project(vertices[frames])
    screens = torch.cat([projected.pixels, projected.depths[..., None]], -1).numpy().astype(np.float32)
    normals = [vertex_normals(posed.numpy(), person.faces) for posed in vertices]
    hits, surfaces = [], []
    for t, frame in enumerate(frames):
        scaled = screens[t] * np.array([SAMPLES, SAMPLES, 1], dtype=np.float32)
        cut = (person.uvs, person.materials, person.textures)
        hits.append(rasterize(scaled, person.faces, SAMPLES * HEIGHT, SAMPLES * WIDTH, cut))
        surfaces.append(surface(hits[t], person, normals[frame] @ cameras.viewmats[t, :3, :3].numpy().T))
    maps = body_maps(body, bare[frames], cameras)
    return Scene(person, surfaces, hits, screens, cameras, _signed_bytes(maps), azimuth.numpy())


def random_clip(rng: np.random.Generator, scene: Scene) -> Clip:
    """Paints and lights a scene, and imitates the coarse avatar of it."""
    paint = random_paint(rng, scene.person, float(_chest(scene.person)))
    lights = _lights(rng, scene)
    size = (FRAMES, SAMPLES * HEIGHT, SAMPLES * WIDTH)
    image = np.full((*size, 3), GREY, dtype=np.float32)
    mask = np.zeros(size, dtype=np.float32)
    totals: dict[str, list[Array]] = {kind: [] for kind in WEARABLES}
    for t, (covered, light) in enumerate(zip(scene.surfaces, lights, strict=True)):
        colour = shade(covered, paint, scene.person, light)
        image[t].reshape(-1, 3)[covered.pixels] = colour
        mask[t].reshape(-1)[covered.pixels] = 1
        for kind in totals:
            totals[kind].append(colour[covered.material == KINDS.index(kind)])
    image, mask = _pooled(image), _pooled(mask)
    observed = [0, int(rng.choice([1, FRAMES - 1]))] if rng.random() < 0.4 else [0]
    coarse, coverage = coarse_frames(_views(rng, scene, image), observed, rng, GREY)
    colours = {kind: np.concatenate(found) for kind, found in totals.items()}
    return Clip(
        image=_bytes(image),
        mask=_bytes(mask),
        part=np.stack([_parts(hits, scene.person) for hits in scene.hits]),
        coarse=_bytes(coarse),
        coverage=_bytes(coverage),
        body=scene.body,
        azimuth=scene.azimuth,
        observed=np.isin(np.arange(FRAMES), observed).astype(np.uint8),
        back_print=has_print(paint, side=1),
        prompt=caption({kind: found.mean(0) for kind, found in colours.items() if len(found) > 40}),
    )


def _posed(body: PackagedBody, person: Dressed, rotations: Tensor) -> tuple[Tensor, Tensor]:
    """Posed vertices of the dressed [P,V,3] and of the bare person [P,Vb,3]."""
    joints = person.joints[None]
    transforms = forward_kinematics(rotations, joints, body.parents, torch.zeros(len(rotations), 3))
    dressed = lbs(torch.from_numpy(person.vertices), torch.from_numpy(person.lbs_weights), transforms)
    bare = lbs(body.shape(person.outfit.betas[None])[0][0], body.lbs_weights, transforms)
    return dressed, bare


def _azimuths(rng: np.random.Generator, turning: bool) -> Tensor:
    """Camera azimuths [T]: a full turn, mostly from the front, or a camera that nearly stands still."""
    start = rng.normal(0, 0.15) if rng.random() < 0.7 else rng.uniform(0, 2 * math.pi)
    if turning:
        steps = torch.arange(FRAMES) * (2 * math.pi / FRAMES) * float(rng.choice([-1, 1]))
    else:
        steps = torch.arange(FRAMES) * float(rng.normal(0, 0.08))
    return (steps.float() + float(start)) % (2 * math.pi)


def _framed(rng: np.random.Generator, bare: Tensor, azimuth: Tensor) -> Cameras:
    """Cameras round the person that frame the bare body, a little jittered."""
    center = 0.5 * (bare.amin((0, 1)) + bare.amax((0, 1)))
    model: CameraModel = "ortho" if rng.random() < 0.3 else "pinhole"
    radius, elevation = float(rng.uniform(2.5, 8)), float(rng.choice([0.0, rng.uniform(-0.1, 0.25)]))
    viewmats = look_at(orbit_eyes(center, radius, azimuth, elevation), center)
    share = PERSON_HEIGHT_SHARE * float(rng.uniform(0.95, 1.02))
    together = bool(rng.random() < 0.88)
    Ks = framing_Ks(viewmats, bare.expand(FRAMES, -1, -1), HEIGHT, WIDTH, model, share, together)
    Ks[:, :2, 2] += torch.tensor(rng.normal(0, 0.7, 2), dtype=torch.float32)
    return Cameras(viewmats, Ks, WIDTH, HEIGHT, model)


def _lights(rng: np.random.Generator, scene: Scene) -> list[Light]:
    """One light a frame: fixed to the camera (the person turns) or to the world (the camera goes round)."""
    ambient, sky = float(rng.uniform(0.5, 0.9)), float(rng.uniform(0, 0.15))
    azimuth, elevation = rng.uniform(-1.2, 1.2), rng.uniform(0.1, 1.1)
    flat = np.array(
        [math.sin(azimuth) * math.cos(elevation), -math.sin(elevation), -math.cos(azimuth) * math.cos(elevation)]
    )
    if rng.random() < 0.6:
        return [Light(ambient, flat, sky)] * FRAMES
    turns = scene.cameras.viewmats[:, :3, :3].numpy()
    world = turns[0].T @ flat
    return [Light(ambient, turn @ world, sky) for turn in turns]


def _views(rng: np.random.Generator, scene: Scene, image: Array) -> list[View]:
    """The frames as `coarse_frames` wants them: one sample a pixel."""
    occluder = random_occluder(rng, HEIGHT, WIDTH)
    views = []
    for t, hits in enumerate(scene.hits):
        face, bary = hits.face[::SAMPLES, ::SAMPLES], hits.bary[::SAMPLES, ::SAMPLES].reshape(-1, 2)
        index = np.flatnonzero(face >= 0)
        chosen, weights = face.ravel()[index], bary[index]
        weights = np.concatenate([1 - weights.sum(1, keepdims=True), weights], 1)
        corners = scene.person.faces[chosen]
        height = (scene.person.vertices[corners, 2] * weights).sum(1)
        depth = np.where(face >= 0, hits.depth[::SAMPLES, ::SAMPLES], np.inf)
        material = scene.person.materials[chosen]
        views.append(View(index, corners, weights, material, height, scene.screens[t], depth, image[t], occluder))
    return views


def _parts(hits: Hits, person: Dressed) -> Array:
    face = hits.face[::SAMPLES, ::SAMPLES]
    return np.where(face >= 0, person.materials[face], BACKGROUND_PART).astype(np.uint8)


def _chest(person: Dressed) -> float:
    """Height of the shoulders at rest, metres."""
    return float(person.features[2:, 2].mean()) - 0.17


def _pooled(values: Array) -> Array:
    total = sum(values[:, row::SAMPLES, column::SAMPLES] for row in range(SAMPLES) for column in range(SAMPLES))
    return np.asarray(total / SAMPLES**2)


def _bytes(values: Array) -> Array:
    return np.round(np.clip(values, 0, 1) * 255).astype(np.uint8)


def _signed_bytes(values: Tensor) -> Array:
    return (values * 127).round().clamp(-127, 127).to(torch.int8).numpy()
