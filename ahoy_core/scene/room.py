"""A small furnished room made of Gaussians by formula: the scene of the demo, the tests and the benchmarks.

Every surface is a rectangle covered with flat Gaussians; colours are albedo times a light that falls off with the
distance from a window, warm, so that there is something to match an avatar's light to. The floor is glossy: its
harmonics make the window's reflection wander with the camera.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ahoy_core.body.rotations import matrix_to_quaternion
from ahoy_core.scene.color import to_linear, to_srgb
from ahoy_core.scene.scene import Scene, make_scene
from ahoy_core.splat.gaussians import Gaussians

_WALL, _OAK, _CLOTH = (0.72, 0.70, 0.66), (0.52, 0.37, 0.24), (0.24, 0.33, 0.36)
_RUG, _PAINT = (0.55, 0.28, 0.22), (0.80, 0.78, 0.72)
_LIGHT = (1.25, 1.1, 0.88)  # linear, warm
_WINDOW = (-2.4, 0.6, 1.7)  # metres
WIDTH, DEPTH, HEIGHT = 5.0, 5.0, 2.6
"""Metres. The room spans x and y from -2.5 to 2.5; people start at the origin, facing the open side (-y)."""


@dataclass(frozen=True)
class _Box:
    """An upright box: lowest corner, size, albedo."""

    corner: tuple[float, float, float]
    size: tuple[float, float, float]
    color: tuple[float, float, float]


_FURNITURE = (
    _Box((-1.15, -1.05, 0.68), (0.95, 0.6, 0.05), _OAK),  # a table, at the left in front
    *(_Box((x, y, 0.0), (0.06, 0.06, 0.68), _OAK) for x in (-1.12, -0.29) for y in (-1.02, -0.54)),
    _Box((0.75, 1.35, 0.0), (1.5, 0.8, 0.42), _CLOTH),  # a sofa at the back
    _Box((0.75, 2.0, 0.42), (1.5, 0.2, 0.42), _CLOTH),
    _Box((-2.3, 1.7, 0.0), (0.9, 0.4, 1.9), _PAINT),  # a cupboard
    _Box((1.55, -0.9, 0.0), (0.4, 0.4, 0.45), _RUG),  # a stool at the right
)


def make_room(pitch: float = 0.045, gloss: float = 0.25) -> Scene:
    """The room.

    Args:
        pitch: Metres between Gaussians: 0.045 gives about 25,000, 0.016 about 200,000.
        gloss: Strength of the floor's reflections; 0 leaves colours without view dependence.

    Raises:
        ValueError: If the pitch is not positive.
    """
    if not pitch > 0:
        raise ValueError(f"expected a positive pitch in metres, got {pitch}")
    half_x, half_y = WIDTH / 2, DEPTH / 2
    patches = [_patch((-half_x, -half_y, 0), (WIDTH, 0, 0), (0, DEPTH, 0), _OAK, pitch, planks=True)]
    patches.append(_patch((-half_x, half_y, 0), (WIDTH, 0, 0), (0, 0, HEIGHT), _WALL, pitch))
    patches.append(_patch((-half_x, -half_y, 0), (0, 0, HEIGHT), (0, DEPTH, 0), _WALL, pitch))
    floor = len(patches[0][0])
    for box in _FURNITURE:
        patches += _faces(box, pitch)
    means, normals, colors, quats = (torch.cat(parts) for parts in zip(*patches, strict=True))
    lit = to_srgb(to_linear(colors) * _irradiance(means, normals))
    spread = torch.tensor([0.62 * pitch, 0.62 * pitch, 0.08 * pitch]).expand(len(means), 3)
    gaussians = Gaussians(means, quats, spread.contiguous(), torch.full((len(means),), 0.97), lit)
    rest = None
    if gloss:
        rest = torch.zeros(len(means), 3, 3)
        # A camera on the far side of a floor Gaussian from the window sees it brighter: linear in the direction.
        away = torch.nn.functional.normalize(means[:floor] - torch.tensor(_WINDOW), dim=1)
        away[:, 2] = away[:, 2].abs()
        # Directions run from the camera to the Gaussian; the bands are ordered y, z, x with signs -, +, -.
        rest[:floor] = 0.5 * gloss * (torch.stack([away[:, 1], -away[:, 2], away[:, 0]], 1) / 0.4886)[..., None]
    return make_scene(gaussians, rest, name="room", up=torch.tensor([0.0, 0.0, 1.0]), metres_per_unit=1.0)


def _patch(
    corner: tuple[float, ...],
    along: tuple[float, ...],
    across: tuple[float, ...],
    color: tuple[float, ...],
    pitch: float,
    planks: bool = False,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Means, normals, albedos and rotations of a rectangle; its normal is along x across."""
    a, b = torch.tensor(along), torch.tensor(across)
    n, m = (max(1, round(float(side.norm()) / pitch)) for side in (a, b))
    i, j = torch.meshgrid((torch.arange(n) + 0.5) / n, (torch.arange(m) + 0.5) / m, indexing="ij")
    means = torch.tensor(corner) + i.reshape(-1, 1) * a + j.reshape(-1, 1) * b
    axes = torch.stack([a / a.norm(), b / b.norm(), torch.linalg.cross(a, b) / (a.norm() * b.norm())], 1)
    albedo = torch.tensor(color).expand(len(means), 3)
    if planks:
        board = torch.floor(means[:, 0] / 0.18)
        tone = 1 + 0.16 * torch.sin(board * 12.9898) * torch.cos(torch.floor(means[:, 1] / 1.2 + 0.37 * board) * 4.1)
        albedo = (albedo * tone[:, None]).clamp(0, 1)
    quats = matrix_to_quaternion(axes).expand(len(means), 4)
    return means, axes[:, 2].expand(len(means), 3), albedo, quats


def _faces(box: _Box, pitch: float) -> list[tuple[Tensor, Tensor, Tensor, Tensor]]:
    """The sides and the top of a box, normals outwards; its underside is never seen."""
    (x, y, z), (w, d, h) = box.corner, box.size
    return [
        _patch((x, y, z + h), (w, 0, 0), (0, d, 0), box.color, pitch),
        _patch((x, y, z), (w, 0, 0), (0, 0, h), box.color, pitch),
        _patch((x + w, y + d, z), (-w, 0, 0), (0, 0, h), box.color, pitch),
        _patch((x, y + d, z), (0, -d, 0), (0, 0, h), box.color, pitch),
        _patch((x + w, y, z), (0, d, 0), (0, 0, h), box.color, pitch),
    ]


def _irradiance(means: Tensor, normals: Tensor) -> Tensor:
    """[N,3] linear light: a window's, falling off with distance, over what the walls send back."""
    to_window = torch.tensor(_WINDOW) - means
    distance = to_window.norm(dim=1).clamp(min=0.4)
    cosine = ((to_window * normals).sum(1) / distance).clamp(min=0)
    shade = 0.42 + 2.1 * cosine / (1 + distance**2 / 3)
    # Corners of the room and the underside of furniture get less.
    height = means[:, 2].clamp(0, 1)
    corner = torch.exp(-(means[:, :2].abs() - 2.5).abs().amin(1) / 0.25)
    return shade[:, None] * torch.tensor(_LIGHT) * (1 - 0.25 * corner * (1 - 0.5 * height))[:, None] / math.sqrt(1.6)
