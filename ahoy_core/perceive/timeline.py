"""From the fitted frames to all frames: poses in between, and confidence per joint."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ahoy_core.body.rotations import axis_angle_to_matrix, so3_exp, so3_log

JOINT_REACH = 0.1  # metres at rest: landmarks this near to a joint speak for it
# Nose, shoulders, elbows, wrists, hips, knees, ankles: each limb counts once in a frame's confidence.
BODY_LANDMARKS = (0, 11, 12, 13, 14, 15, 16, 23, 24, 25, 26, 27, 28)


def neighbours(
    used: NDArray[np.bool_], pts: NDArray[np.floating], shot: NDArray[np.integer]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """For every frame, the used frames before and after it and where it lies between them.

    Args:
        used: [T], at least one true.
        pts: [T] seconds.
        shot: [T]; a frame takes its pose from its own shot, if anything was used there.

    Returns:
        before [T], after [T] (indices of frames; equal at the ends and for used frames) and share [T] in [0,1].

    Raises:
        ValueError: no frame is used.
    """
    if not used.any():
        raise ValueError("expected at least one used frame, got none")
    before, after = np.arange(len(used)), np.arange(len(used))
    share = np.zeros(len(used))
    for t in np.flatnonzero(~used):
        known = np.flatnonzero(used & (shot == shot[t]))
        known = known if len(known) else np.flatnonzero(used)
        earlier, later = known[known < t], known[known > t]
        before[t] = earlier[-1] if len(earlier) else later[0]
        after[t] = later[0] if len(later) else earlier[-1]
        span = float(pts[after[t]] - pts[before[t]])
        share[t] = (pts[t] - pts[before[t]]) / span if span > 0 else 0.0
    return before, after, share


def spread_poses(
    pose: Tensor, transl: Tensor, used: NDArray[np.bool_], pts: NDArray[np.floating], shot: NDArray[np.integer]
) -> tuple[Tensor, Tensor]:
    """Interpolate poses of the used frames over all frames: rotations along the shortest turn, positions linearly.

    Args:
        pose: [N,J,3] axis-angle of the used frames.
        transl: [N,3].
        used: [T], N of them true.
        pts: [T] seconds.
        shot: [T].

    Returns:
        pose [T,J,3] and transl [T,3].
    """
    before, after, share = neighbours(used, pts, shot)
    row = np.cumsum(used) - 1
    first, second = torch.from_numpy(row[before]), torch.from_numpy(row[after])
    part = torch.from_numpy(share).to(pose)[:, None, None]
    start, end = axis_angle_to_matrix(pose[first]), axis_angle_to_matrix(pose[second])
    turn = so3_log(start.transpose(-1, -2) @ end)
    moved = so3_log(start @ so3_exp(part * turn))
    held = torch.from_numpy(before == after)[:, None, None]
    return torch.where(held, pose[first], moved), torch.lerp(transl[first], transl[second], part[:, 0])


def joint_confidence(landmarks: Tensor, joints: Tensor, confidence: Tensor) -> Tensor:
    """Spread the landmarks' confidence over the joints near them.

    Args:
        landmarks: [33,3] of the body at rest.
        joints: [J,3] at rest.
        confidence: [N,33] in [0,1].

    Returns:
        [N,J] in [0,1]; a joint with no landmark near takes its nearest one's.
    """
    squared = torch.cdist(joints, landmarks).square() / JOINT_REACH**2
    weights = torch.softmax(-0.5 * squared, dim=1)
    return (confidence @ weights.T.to(confidence)).clamp(0.0, 1.0)


def frame_confidence(confidence: Tensor) -> Tensor:
    """Mean confidence [N] over the body's main landmarks, from [N,33]."""
    return confidence[:, list(BODY_LANDMARKS)].mean(1)


def ranges(flags: NDArray[np.bool_]) -> list[list[int]]:
    """Runs of true values as [first, last] pairs, for notes."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int8), [0]])))
    return [[int(a), int(b) - 1] for a, b in zip(edges[::2], edges[1::2], strict=True)]
