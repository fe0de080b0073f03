"""A small avatar and small scenes, for tests of planning and rendering."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import torch
from torch import Tensor

from ahoy_core.avatar import Avatar, AvatarInfo
from ahoy_core.avatar.avatar import bake, bake_full, network_config
from ahoy_core.avatar.deform import OffsetBounds, offset_channels
from ahoy_core.avatar.full_model import full_network_config
from ahoy_core.avatar.kinematics import Kinematics
from ahoy_core.avatar.pose_maps import PoseMaps
from ahoy_core.avatar.posing import PoseDependence
from ahoy_core.body.canonical import canonical_pose
from ahoy_core.body.packaged import PackagedBody, load_packaged_body
from ahoy_core.body.rotations import axis_angle_to_matrix
from ahoy_core.conventions import Cameras, look_at, perspective_K
from ahoy_core.maps import StyleUNet
from ahoy_core.motion import Motion, load_motion, placed
from ahoy_core.scene.puppet import Puppet
from ahoy_core.scene.room import make_room
from ahoy_core.scene.scene import Scene, make_scene
from ahoy_core.splat import Gaussians
from tests.avatar.scenes import dressed

SIZE = 96


def body() -> PackagedBody:
    return load_packaged_body()


@cache
def avatar(map_size: int = 64) -> Avatar:
    start = dressed(map_size)
    network = StyleUNet(network_config(start, 4, offset_channels(start)), torch.Generator().manual_seed(0))
    info = AvatarInfo(body=body().name, provenance={"source": "a test"})
    return bake(start, network, OffsetBounds(), body().default_betas, canonical_pose(body())[None], info)


def puppet(
    motion: str | Motion = "still", at: tuple[float, float, float] = (0.0, 0.0, 0.0), frames: int = 4, fps: float = 12.0
) -> Puppet:
    who = avatar()
    made = load_motion(motion, body(), who.betas, fps, frames) if isinstance(motion, str) else motion
    rest = Puppet(who, body(), made).rest[0]
    x, y, heading = at
    return Puppet(who, body(), placed(made, torch.tensor([x, y, 0.0]), math.radians(heading), rest))


def moved(who: Puppet, change: Callable[[Tensor], Tensor]) -> Puppet:
    """A puppet whose translations went through a function."""
    return replace(who, motion=replace(who.motion, transl=change(who.motion.transl)))


def camera(
    eye: tuple[float, float, float] = (1.0, -4.0, 1.4),
    to: tuple[float, float, float] = (0.0, 0.2, 0.8),
    size: int = SIZE,
) -> Cameras:
    view = look_at(torch.tensor(eye), torch.tensor(to))
    return Cameras(view[None], perspective_K(math.radians(40), size, size)[None], size, size)


@cache
def room() -> Scene:
    """The furnished room, coarsely."""
    return make_room(pitch=0.1)


def floor(level: float = 0.5, pitch: float = 0.06, extent: float = 1.6, z: float = 0.0) -> Scene:
    """A grey floor and nothing else."""
    steps = torch.arange(-extent, extent, pitch)
    x, y = torch.meshgrid(steps, steps, indexing="ij")
    means = torch.stack([x.reshape(-1), y.reshape(-1), torch.full((x.numel(),), z)], 1)
    return make_scene(flat(means, pitch, level), up=torch.tensor([0.0, 0.0, 1.0]), metres_per_unit=1.0)


def wall(y: float, level: float = 0.5, pitch: float = 0.08) -> Scene:
    """A grey wall across the view at depth y, and nothing else."""
    steps = torch.arange(-1.5, 1.5, pitch)
    x, z = torch.meshgrid(steps, steps + 1.0, indexing="ij")
    means = torch.stack([x.reshape(-1), torch.full((x.numel(),), y), z.reshape(-1)], 1)
    upright = torch.tensor([math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0]).expand(len(means), 4)
    return make_scene(replace(flat(means, pitch, level), quats=upright.contiguous()), up=torch.tensor([0.0, 0.0, 1.0]))


def flat(means: Tensor, pitch: float, level: float = 0.5) -> Gaussians:
    """Flat Gaussians, facing z, that cover a grid of this pitch."""
    count = len(means)
    scales = torch.tensor([0.6, 0.6, 0.05]).mul(pitch).expand(count, 3).contiguous()
    quats = torch.tensor([1.0, 0, 0, 0]).expand(count, 4).contiguous()
    return Gaussians(means, quats, scales, torch.full((count,), 0.95), torch.full((count, 3), level))


def smiling(frames: int = 4, amount: float = 1.0) -> Motion:
    """Standing still with an open mouth."""
    still = load_motion("still", body(), avatar().betas, 12.0, frames)
    expression = torch.zeros(frames, body().n_expressions)
    expression[:, body().expression_names.index("jawOpen")] = amount
    return replace(still, expression=expression)


def full_avatar() -> Avatar:
    """A pose-dependent avatar that was never trained: its Gaussians come from the map of each pose."""
    start = dressed(64)
    maps = PoseMaps(start, Kinematics.of(body(), body().default_betas), 2)
    network = StyleUNet(full_network_config(maps, 4), torch.Generator().manual_seed(0))
    base = torch.zeros(len(start), offset_channels(start))
    posing = PoseDependence(base, axis_angle_to_matrix(canonical_pose(body()))[None], 2, 4, 1.0)
    info = AvatarInfo(body=body().name, provenance={"source": "a test"})
    poses = canonical_pose(body())[None]
    return bake_full(maps, network, OffsetBounds(), posing, body().default_betas, poses, info)
