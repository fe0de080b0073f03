"""A person who moves as we say, seen by a camera that we know: landmarks whose truth is known to the last digit."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ahoy_core.body.keypoints import keypoints
from ahoy_core.body.model import BodyModel
from ahoy_core.conventions import OBSERVED_VIEWMAT, project
from ahoy_core.perceive.residuals import Observations

HEIGHT, WIDTH, FOCAL = 480, 640, 700.0


@dataclass(frozen=True)
class Scene:
    """The truth, and what a perfect landmark network would see of it."""

    pose: Tensor
    transl: Tensor
    betas: Tensor
    joints: Tensor
    seen: Observations


def camera() -> Tensor:
    return torch.tensor([[FOCAL, 0.0, WIDTH / 2], [0.0, FOCAL, HEIGHT / 2], [0.0, 0.0, 1.0]])


def make_scene(body: BodyModel, frames: int = 6, facing: float = 0.3, fps: float = 15.0) -> Scene:
    """Arms and knees bend while the person turns a little; `facing` is the turn in radians at the start."""
    index = {name: i for i, name in enumerate(body.joint_names)}
    time = torch.arange(frames) / max(frames - 1, 1)
    pose = torch.zeros(frames, body.n_joints, 3)
    pose[:, 0, 2] = facing + 0.3 * time
    pose[:, index["upperarm01.L"], 1] = 0.5 - 0.9 * time
    pose[:, index["lowerarm01.R"], 2] = 0.3 + 0.6 * time
    for side in "LR":
        pose[:, index[f"upperleg01.{side}"], 0] = -0.5 * time
        pose[:, index[f"lowerleg01.{side}"], 0] = 0.9 * time
    transl = torch.tensor([0.1, 3.5, -0.9]).repeat(frames, 1)
    betas = body.default_betas.clone()
    output = body(pose, betas[None], transl)
    points = keypoints(body, output)
    hips = points[:, 23:25].mean(1, keepdim=True)
    seen = Observations(
        points=project(points, OBSERVED_VIEWMAT, camera()).pixels,
        weights=torch.ones(frames, 33),
        world=points - hips,
        times=torch.arange(frames) / fps,
        shot=torch.zeros(frames, dtype=torch.int64),
        K=camera(),
    )
    return Scene(pose, transl, betas, output.joints, seen)


def similarity_error(ours: Tensor, theirs: Tensor) -> Tensor:
    """Mean distance [N] after the best similarity per frame (PA-MPJPE), same unit as the input [N,J,3]."""
    a, b = ours - ours.mean(1, keepdim=True), theirs - theirs.mean(1, keepdim=True)
    u, s, vt = torch.linalg.svd(a.transpose(1, 2) @ b)
    sign = torch.ones_like(s)
    sign[:, 2] = torch.det(u @ vt).sign()
    scale = (s * sign).sum(1) / a.square().sum((1, 2))
    return (scale[:, None, None] * (a @ ((u * sign[:, None]) @ vt)) - b).norm(dim=-1).mean(1)
