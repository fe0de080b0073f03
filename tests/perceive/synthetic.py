"""A person who moves as we say, seen by a camera that we know: landmarks whose truth is known to the last digit."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ahoy_core.body.keypoints import keypoints
from ahoy_core.body.model import BodyModel
from ahoy_core.body.phenotype import BETA_NAMES
from ahoy_core.conventions import OBSERVED_VIEWMAT, project
from ahoy_core.perceive.masks import silhouette
from ahoy_core.perceive.objective import STATURE
from ahoy_core.perceive.reduced import reduce_body
from ahoy_core.perceive.residuals import Observations

PER_FRAME = ("points", "weights", "world", "world_weights", "visible")  # of the observations
HEIGHT, WIDTH, FOCAL = 480, 640, 700.0
STATURE_BETA = BETA_NAMES.index("height")


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


def average_betas(body: BodyModel) -> Tensor:
    """The body's default shape [S] with the stature that the fit takes for average; the default is 1.84 m tall."""
    betas = body.default_betas.clone()
    for _ in range(3):
        reduced = reduce_body(body, (0,), betas.double())
        slope = reduced.stature_slopes[STATURE_BETA]
        betas[STATURE_BETA] += ((STATURE - reduced.stature) / slope).float()
    return betas


def make_scene(
    body: BodyModel,
    frames: int = 6,
    facing: float = 0.3,
    fps: float = 15.0,
    betas: Tensor | None = None,
    rise: float = -0.9,
) -> Scene:
    """Arms and knees bend while the person turns a little.

    `facing` is the turn in radians at the start; `rise` the metres above the camera: by default the picture ends at the
    thighs, at 0 it holds the whole person.
    """
    index = {name: i for i, name in enumerate(body.joint_names)}
    time = torch.arange(frames) / max(frames - 1, 1)
    pose = torch.zeros(frames, body.n_joints, 3)
    pose[:, 0, 2] = facing + 0.3 * time
    pose[:, index["upperarm01.L"], 1] = 0.5 - 0.9 * time
    pose[:, index["lowerarm01.R"], 2] = 0.3 + 0.6 * time
    for side in "LR":
        pose[:, index[f"upperleg01.{side}"], 0] = -0.5 * time
        pose[:, index[f"lowerleg01.{side}"], 0] = 0.9 * time
    transl = torch.tensor([0.1, 3.5, rise]).repeat(frames, 1)
    betas = average_betas(body) if betas is None else betas
    output = body(pose, betas[None], transl)
    points = keypoints(body, output)
    hips = points[:, 23:25].mean(1, keepdim=True)
    seen = Observations(
        points=project(points, OBSERVED_VIEWMAT, camera()).pixels,
        weights=torch.ones(frames, 33),
        world=points - hips,
        world_weights=torch.ones(frames, 33),
        visible=torch.ones(frames, 33),
        times=torch.arange(frames) / fps,
        shot=torch.zeros(frames, dtype=torch.int64),
        K=camera(),
    )
    return Scene(pose, transl, betas, output.joints, seen)


def weighted(seen: Observations, weights: Tensor) -> Observations:
    """The same observations, trusted by weights [N,33] in the picture, in space and as seen."""
    return replace(seen, weights=weights, world_weights=weights, visible=weights)


def draw_masks(body: BodyModel, scene: Scene) -> NDArray[np.uint8]:
    """What a perfect segmentation would see, [N,H,W]."""
    vertices = body(scene.pose, scene.betas[None], scene.transl).vertices.numpy()
    faces, K = body.faces.numpy(), camera().numpy()
    return np.stack([silhouette(v, faces, K, HEIGHT, WIDTH) for v in vertices])


def similarity_error(ours: Tensor, theirs: Tensor) -> Tensor:
    """Mean distance [N] after the best similarity per frame (PA-MPJPE), same unit as the input [N,J,3]."""
    a, b = ours - ours.mean(1, keepdim=True), theirs - theirs.mean(1, keepdim=True)
    u, s, vt = torch.linalg.svd(a.transpose(1, 2) @ b)
    sign = torch.ones_like(s)
    sign[:, 2] = torch.det(u @ vt).sign()
    scale = (s * sign).sum(1) / a.square().sum((1, 2))
    return (scale[:, None, None] * (a @ ((u * sign[:, None]) @ vt)) - b).norm(dim=-1).mean(1)
