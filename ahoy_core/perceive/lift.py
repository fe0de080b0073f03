"""Where the fit starts: orientation from the network's 3D torso, position from a linear solve."""

from __future__ import annotations

import torch
from torch import Tensor

from ahoy_core.body.rotations import nearest_rotation
from ahoy_core.perceive.residuals import MIN_DEPTH, Observations

TORSO = (11, 12, 23, 24)  # shoulders and hips
ENOUGH_WEIGHT = 0.5  # of the four; below it the torso is hidden, and a start is needed all the same
DEPTH_SPREAD = (
    0.1  # metres that a person's depth differs from the clip's median, in the linear solve: limbs are off at the start
)


def root_rotations(rest_landmarks: Tensor, seen: Observations) -> Tensor:
    """Turn the resting torso onto the seen one (Kabsch), whichever way the person faces.

    Args:
        rest_landmarks: [33,3] of the body at rest.
        seen: the observations.

    Returns:
        [N,3,3] root rotations in the world.
    """
    torso = list(TORSO)
    weights = seen.world_weights[:, torso, None]
    weights = torch.where(weights.sum(1, keepdim=True) < ENOUGH_WEIGHT, torch.ones_like(weights), weights)
    weights = weights / weights.sum(1, keepdim=True)
    theirs = seen.world[:, torso]
    ours = rest_landmarks[torso].expand_as(theirs)
    theirs = theirs - (weights * theirs).sum(1, keepdim=True)
    ours = ours - (weights * ours).sum(1, keepdim=True)
    return nearest_rotation((weights * theirs).transpose(1, 2) @ ours)


def translations(landmarks: Tensor, seen: Observations) -> Tensor:
    """Place bodies so that they project onto the seen landmarks, by weighted linear least squares.

    Args:
        landmarks: [N,33,3] posed, with zero translation.
        seen: the observations.

    Returns:
        [N,3] metres, in front of the camera. Depth is held near its median over the frames, which makes frames with few
        landmarks solvable.
    """
    focal = torch.stack([seen.K[0, 0], seen.K[1, 1]])
    u, v = ((seen.points - seen.K[:2, 2]) / focal).unbind(-1)
    x, y, z = landmarks.unbind(-1)
    zero, one = torch.zeros_like(u), torch.ones_like(u)
    # (x + tx) = u (y + ty) and -(z + tz) = v (y + ty)
    rows = torch.cat([torch.stack([one, -u, zero], -1), torch.stack([zero, -v, -one], -1)], dim=1)
    right = torch.cat([u * y - x, v * y + z], dim=1)
    weights = torch.cat([seen.weights, seen.weights], dim=1)
    free = _solve(rows, right, weights, None)
    depth = free[:, 1].median().clamp_min(10 * MIN_DEPTH)
    return _solve(rows, right, weights, depth)


def _solve(rows: Tensor, right: Tensor, weights: Tensor, depth: Tensor | None) -> Tensor:
    """Solve the normal equations [N,3,3], with a pull of the middle unknown towards `depth` if there is one."""
    weighted = rows * weights[..., None]
    normal = weighted.transpose(1, 2) @ rows
    target = (weighted.transpose(1, 2) @ right[..., None])[..., 0]
    ridge = 1e-6 * torch.eye(3, dtype=rows.dtype)
    if depth is not None:
        # Residuals of the rows are metres; one row's spread is taken as 5 cm.
        pull = (0.05 / DEPTH_SPREAD) ** 2
        ridge = ridge + torch.diag(rows.new_tensor([0.0, pull, 0.0]))
        target = target + rows.new_tensor([0.0, pull, 0.0]) * depth
    return torch.linalg.solve(normal + ridge, target)
