"""What the hard cases share: rows set by hand in a calm scene, and frontal scenes whose camera depths are exact."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from tests.splat.scenes import Scene, convert, random_scene

Render = Callable[..., Any]
"""`rasterization`, on the CPU or there and back over a GPU."""


def with_rows(scene: Scene, rows: slice | list[int], **values: Any) -> Scene:
    """A copy of the scene with these rows of some inputs replaced."""
    scene = dict(scene)
    for name, value in values.items():
        scene[name] = scene[name].clone()
        scene[name][rows] = torch.as_tensor(value, dtype=scene[name].dtype)
    return scene


def camera_space(scene: Scene, points: Tensor) -> Tensor:
    """World positions [M,3] of points given in the axes of the scene's first camera."""
    viewmat = scene["viewmats"][0].double()
    return (points.double() - viewmat[:3, 3]) @ viewmat[:3, :3]


def frontal_scene(n: int, seed: int = 0, width: int = 24, height: int = 20, **options: Any) -> Scene:
    """Gaussians before a camera at the origin that looks along z, so that means[:, 2] is the depth, bit for bit."""
    scene = random_scene(seed, n=n, width=width, height=height, dtype=torch.float64)
    scene["means"][:, 2] += 3
    scene["viewmats"] = torch.eye(4, dtype=torch.float64)[None]
    return {**convert(scene, torch.float32), **options}


def all_but(n: int, *rows: int) -> Tensor:
    """Indices of all n Gaussians except these."""
    return torch.tensor([i for i in range(n) if i not in rows])
