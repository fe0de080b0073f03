"""What the fit minimises: residuals in metres or radians over their standard deviations, smooth and finite everywhere.

Image errors are measured in metres at the person's depth: one set of standard deviations holds for every picture size and
distance.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

LANDMARK_SPREAD = 0.04  # metres: agreement of a visible landmark with the body's, across the line of sight
WORLD_SPREAD = 0.15  # metres: of the network's own 3D, which is much weaker along the line of sight
MIN_DEPTH = 0.1  # metres: nearer points, and those behind, project as if they were about there


@dataclass(frozen=True)
class Observations:
    """What was seen in the N frames that are fitted.

    Attributes:
        points: [N,33,2] pixels.
        weights: [N,33] in [0,1]; what weighs 0 has no influence at all.
        world: [N,33,3] metres in world axes (z up), hips at the origin.
        times: [N] seconds.
        shot: [N] shot numbers.
        K: [3,3] pixels.
    """

    points: Tensor
    weights: Tensor
    world: Tensor
    times: Tensor
    shot: Tensor
    K: Tensor


def geman_mcclure(squared: Tensor, scale: float) -> Tensor:
    """Geman-McClure's robust cost of a squared distance: like it near 0, never above scale^2."""
    return squared * scale**2 / (squared + scale**2)


def image_offsets(landmarks: Tensor, seen: Observations) -> Tensor:
    """Offsets [N,33,2] between projected and seen landmarks, in metres at the person's depth.

    Args:
        landmarks: [N,33,3] world, seen by `OBSERVED_VIEWMAT` (x_cam = x, y_cam = -z, depth = y).
        seen: the observations.
    """
    depth = landmarks[..., 1]
    safe = MIN_DEPTH * (1.0 + torch.nn.functional.softplus(depth / MIN_DEPTH - 1.0))
    plane = torch.stack([landmarks[..., 0], -landmarks[..., 2]], dim=-1) / safe[..., None]
    focal = torch.stack([seen.K[0, 0], seen.K[1, 1]])
    rays = (seen.points - seen.K[:2, 2]) / focal
    person = depth.detach().mean(-1).clamp_min(MIN_DEPTH)
    return (plane - rays) * person[:, None, None]


def image_cost(landmarks: Tensor, seen: Observations, scale: float) -> Tensor:
    """Robust reprojection cost [N]; `scale` in metres is where a landmark begins to count as wrong."""
    squared = image_offsets(landmarks, seen).square().sum(-1)
    return (seen.weights * geman_mcclure(squared, scale)).sum(-1) / LANDMARK_SPREAD**2


def world_cost(landmarks: Tensor, seen: Observations, log_scale: Tensor, scale: float) -> Tensor:
    """Robust cost [N] of the network's 3D, relative to the weighted mean; its metre is off by one factor a video.

    Args:
        landmarks: [N,33,3] world.
        seen: the observations.
        log_scale: [] logarithm of that factor.
        scale: metres.
    """
    weights = seen.weights[..., None]
    total = weights.sum(1, keepdim=True).clamp_min(1e-6)
    ours = landmarks - (weights * landmarks).sum(1, keepdim=True) / total
    theirs = seen.world - (weights * seen.world).sum(1, keepdim=True) / total
    squared = (ours - log_scale.exp() * theirs).square().sum(-1)
    return (seen.weights * geman_mcclure(squared, scale)).sum(-1) / WORLD_SPREAD**2


def acceleration(joints: Tensor, seen: Observations) -> Tensor:
    """Accelerations [M,F,3] in m/s^2 at frames whose two neighbours belong to the same shot, for any spacing in time.

    Args:
        joints: [N,F,3] world.
        seen: the observations.
    """
    gaps = (seen.times[1:] - seen.times[:-1]).clamp_min(1e-3)
    velocity = (joints[1:] - joints[:-1]) / gaps[:, None, None]
    change = (velocity[1:] - velocity[:-1]) * 2.0 / (gaps[1:] + gaps[:-1])[:, None, None]
    inside = (seen.shot[2:] == seen.shot[1:-1]) & (seen.shot[1:-1] == seen.shot[:-2])
    return change[inside]


def depth_velocity(points: Tensor, seen: Observations) -> Tensor:
    """Speeds [M] in m/s along the line of sight (world y), between neighbouring frames of one shot; points [N,3]."""
    gaps = (seen.times[1:] - seen.times[:-1]).clamp_min(1e-3)
    return ((points[1:, 1] - points[:-1, 1]) / gaps)[seen.shot[1:] == seen.shot[:-1]]
