"""Human-shaped clouds of Gaussians with realistic overlap, for measuring rasterizers."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

# (end a, end b, radius) in metres, y down: torso, head, upper and lower limbs
CAPSULES = (
    ((0, -0.55, 0), (0, 0.15, 0), 0.17),
    ((0, -0.8, 0), (0, -0.72, 0), 0.11),
    ((-0.22, -0.5, 0), (-0.5, -0.1, 0.05), 0.055),
    ((0.22, -0.5, 0), (0.5, -0.1, -0.05), 0.055),
    ((-0.5, -0.1, 0.05), (-0.62, 0.25, 0.15), 0.045),
    ((0.5, -0.1, -0.05), (0.62, 0.25, 0.1), 0.045),
    ((-0.1, 0.2, 0), (-0.15, 0.6, 0.05), 0.085),
    ((0.1, 0.2, 0), (0.16, 0.6, -0.05), 0.085),
    ((-0.15, 0.6, 0.05), (-0.16, 1.0, 0), 0.06),
    ((0.16, 0.6, -0.05), (0.2, 1.0, 0.05), 0.06),
)


@dataclass(frozen=True)
class SceneSpec:
    """Size of one benchmark scene; `spread` scales the Gaussians so that each scene has the same overlap per pixel."""

    name: str
    n: int
    size: int
    spread: float


SCENES = (
    SceneSpec("10k@256", 10_000, 256, 6.0),
    SceneSpec("50k@512", 50_000, 512, 6.5),
    SceneSpec("200k@1024", 200_000, 1024, 6.5),
)


@dataclass(frozen=True)
class Scene:
    """Arguments of a rasterization, float32; and the gradient of the image that backward starts from."""

    spec: SceneSpec
    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor
    viewmats: Tensor
    Ks: Tensor
    backgrounds: Tensor
    v_render: Tensor


def make_scene(spec: SceneSpec, seed: int = 0) -> Scene:
    """Draw a scene: three quarters of the Gaussians on a body, the rest in clusters round it."""
    rng = np.random.default_rng(seed)
    on_body = int(spec.n * 0.75)
    means = np.concatenate([_on_capsules(rng, on_body), _in_clusters(rng, spec.n - on_body)])
    log_scales = math.log(0.35 / math.sqrt(spec.n) * spec.spread) + rng.normal(size=(spec.n, 3)) * 0.5
    log_scales[:, 2] -= 1.2  # flat, as on a surface
    log_scales[on_body:] += 0.7
    order = rng.permutation(spec.n)
    angle = 0.2
    view = np.eye(4)
    view[:3, :3] = [[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]]
    view[:3, 3] = [0.02, -0.05, 2.6]
    focal, half = 1.15 * spec.size, spec.size / 2

    def tensor(value: np.ndarray | list) -> Tensor:
        return torch.as_tensor(np.asarray(value), dtype=torch.float32).contiguous()

    return Scene(
        spec,
        means=tensor(means[order]),
        quats=tensor(rng.normal(size=(spec.n, 4))),
        scales=tensor(np.exp(log_scales)[order]),
        opacities=tensor(1 / (1 + np.exp(1.0 - 1.8 * rng.normal(size=spec.n)))),
        colors=tensor(rng.random((spec.n, 3))),
        viewmats=tensor(view[None]),
        Ks=tensor([[[focal, 0, half], [0, focal, half], [0, 0, 1]]]),
        backgrounds=tensor([[0.1, 0.2, 0.3]]),
        v_render=tensor(rng.normal(size=(1, spec.size, spec.size, 3))),
    )


def _on_capsules(rng: np.random.Generator, n: int) -> np.ndarray:
    starts, ends = np.array([c[0] for c in CAPSULES], float), np.array([c[1] for c in CAPSULES], float)
    radii = np.array([c[2] for c in CAPSULES])
    area = np.linalg.norm(starts - ends, axis=1) * radii + radii**2
    pick = rng.choice(len(CAPSULES), n, p=area / area.sum())
    along = rng.random((n, 1))
    out = rng.normal(size=(n, 3))
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    axis = starts[pick] * (1 - along) + ends[pick] * along
    return axis + out * radii[pick, None] + rng.normal(size=(n, 3)) * 0.008


def _in_clusters(rng: np.random.Generator, n: int) -> np.ndarray:
    centres = rng.normal(size=(24, 3)) * [1.1, 1.0, 0.5] + [0, 0, 1.3]
    return centres[rng.integers(0, 24, n)] + rng.normal(size=(n, 3)) * 0.28
