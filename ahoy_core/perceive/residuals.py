"""What the fit minimises: distances in metres over their standard deviations, finite everywhere.

Image errors are measured in metres at the person's depth: one set of standard deviations holds for every picture size
and distance.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

LANDMARK_SPREAD = 0.05  # metres: agreement of a visible landmark with the body's, across the line of sight
WORLD_SPREAD = 0.15  # metres: of the network's own 3D, which is much weaker along the line of sight
MIN_DEPTH = 0.1  # metres: nearer points, and those behind, project as if they were about there


@dataclass(frozen=True)
class Observations:
    """What was seen in the N frames that are fitted.

    Attributes:
        points: [N,33,2] pixels.
        weights: [N,33] in [0,1] of the points; what weighs 0 has no influence at all.
        world: [N,33,3] metres in world axes (z up), hips at the origin.
        world_weights: [N,33] in [0,1] of `world`.
        visible: [N,33] in [0,1]: how sure it is that the landmark is seen, not guessed.
        times: [N] seconds.
        shot: [N] shot numbers.
        K: [3,3] pixels.
        ground: [4] the floor's upward unit normal in world axes, and metres that the world's origin (the camera) is
            above the floor; None where unknown.
    """

    points: Tensor
    weights: Tensor
    world: Tensor
    world_weights: Tensor
    visible: Tensor
    times: Tensor
    shot: Tensor
    K: Tensor
    ground: Tensor | None = None


def geman_mcclure(squared: Tensor, scale: float) -> Tensor:
    """Geman-McClure's robust cost of a squared distance: like it near 0, never above scale^2."""
    return squared * scale**2 / (squared + scale**2)


def geman_mcclure_weight(squared: Tensor, scale: float) -> Tensor:
    """Its derivative, in (0,1]: the weight of a residual in reweighted least squares."""
    return (scale**2 / (squared + scale**2)) ** 2


def safe_depth(depth: Tensor) -> Tensor:
    """The depth itself from a few `MIN_DEPTH` on; below it bends smoothly towards `MIN_DEPTH` and never reaches it."""
    return MIN_DEPTH * (1.0 + torch.nn.functional.softplus(depth / MIN_DEPTH - 1.0))


def person_depth(landmarks: Tensor) -> Tensor:
    """Depth [N] that turns image errors into metres: the landmarks' mean, held constant while a step is sought."""
    return landmarks[..., 1].detach().mean(-1).clamp_min(MIN_DEPTH)


def image_offsets(landmarks: Tensor, seen: Observations, person: Tensor) -> Tensor:
    """Offsets [N,33,2] between projected and seen landmarks, in metres at the person's depth.

    Args:
        landmarks: [N,33,3] world, seen by `OBSERVED_VIEWMAT` (x_cam = x, y_cam = -z, depth = y).
        seen: the observations.
        person: [N] metres, see `person_depth`.
    """
    plane = torch.stack([landmarks[..., 0], -landmarks[..., 2]], dim=-1) / safe_depth(landmarks[..., 1])[..., None]
    focal = torch.stack([seen.K[0, 0], seen.K[1, 1]])
    rays = (seen.points - seen.K[:2, 2]) / focal
    return (plane - rays) * person[:, None, None]


def image_derivatives(landmarks: Tensor, person: Tensor) -> Tensor:
    """Derivatives [N,33,2,3] of `image_offsets` by the landmarks."""
    depth = landmarks[..., 1]
    inverse = person[:, None] / safe_depth(depth)
    bend = torch.sigmoid(depth / MIN_DEPTH - 1.0) * inverse / safe_depth(depth)
    zero = torch.zeros_like(inverse)
    across = torch.stack([inverse, -landmarks[..., 0] * bend, zero], dim=-1)
    down = torch.stack([zero, landmarks[..., 2] * bend, -inverse], dim=-1)
    return torch.stack([across, down], dim=-2)


def centred(points: Tensor, weights: Tensor) -> Tensor:
    """Points [N,33,...] less their weighted mean; nothing is taken off where all weights are 0."""
    share = weights / weights.sum(1, keepdim=True).clamp_min(1e-6)
    flat = points.flatten(2)
    return (flat - (share[..., None] * flat).sum(1, keepdim=True)).reshape(points.shape)


def world_offsets(landmarks: Tensor, seen: Observations, log_scale: Tensor) -> Tensor:
    """Offsets [N,33,3] in metres between the body's 3D and the network's, scaled, each about its mean."""
    return centred(landmarks, seen.world_weights) - log_scale.exp() * centred(seen.world, seen.world_weights)


@dataclass(frozen=True)
class Differences:
    """Finite differences in time for any spacing, within shots.

    Attributes:
        speed_first: [M1] first frame of each pair of neighbours.
        speed: [M1,2] coefficients in 1/s.
        bend_first: [M2] first frame of each triple.
        bend: [M2,3] coefficients in 1/s^2.
    """

    speed_first: Tensor
    speed: Tensor
    bend_first: Tensor
    bend: Tensor


def differences(seen: Observations) -> Differences:
    """Set up speeds and accelerations between neighbouring frames of one shot."""
    gaps = (seen.times[1:] - seen.times[:-1]).clamp_min(1e-3)
    same = seen.shot[1:] == seen.shot[:-1]
    pairs = same.nonzero()[:, 0]
    triples = (same[1:] & same[:-1]).nonzero()[:, 0]
    before, after = gaps[triples], gaps[triples + 1]
    near, far = 2 / (before * (before + after)), 2 / (after * (before + after))
    rate = 1 / gaps[pairs]
    return Differences(pairs, torch.stack([-rate, rate], 1), triples, torch.stack([near, -near - far, far], 1))


def apply_differences(values: Tensor, first: Tensor, coefficients: Tensor) -> Tensor:
    """Combine successive frames: values [N,...] -> [M,...]."""
    shape = (-1,) + (1,) * (values.ndim - 1)
    parts = [coefficients[:, i].reshape(shape) * values[first + i] for i in range(coefficients.shape[1])]
    return torch.stack(parts).sum(0)
