"""Perceiving with real models: which of the roles pose, mask and head are filled otherwise than by default.

Who is who stays with our own tracker: the models are told where the subject is, frame by frame, and answer for it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ahoy_core.body.keypoints import keypoints
from ahoy_core.body.model import BodyModel
from ahoy_core.models.contracts import Head, Mask, Pose, PoseEstimate
from ahoy_core.perceive.adopt import adopt
from ahoy_core.perceive.fit import AGREEMENT, Fit
from ahoy_core.perceive.landmarks import LandmarkTrack
from ahoy_core.perceive.residuals import Observations, image_offsets, person_depth

AROUND = 0.12  # of the landmarks' box on each side: hair, hands and feet stand over it
SEEN = 0.3  # visibility from which a landmark says where the person is
PIECE = 64  # frames handed to a model at once: bounds the float pictures in memory
SHOT = 240  # likewise for masks, which follow people through a shot

Frames = NDArray[np.uint8]


@dataclass(frozen=True)
class Filled:
    """Models that fill roles; None where the embedded default does."""

    pose: Pose | None = None
    mask: Mask | None = None
    head: Head | None = None


def subject_boxes(track: LandmarkTrack, looked: NDArray[np.int64], count: int, height: int, width: int) -> Tensor:
    """Where the subject is: boxes [count,4] x0 y0 x1 y1 in pixels within the picture, NaN where it was not found."""
    boxes = torch.full((count, 4), float("nan"))
    for row, t in enumerate(looked.tolist()):
        if not track.found[row]:
            continue
        seen = track.visibility[row] >= SEEN
        points = torch.from_numpy(track.landmarks[row, seen if seen.sum() > 1 else slice(None), :2]).float()
        low, high = points.amin(0), points.amax(0)
        margin = AROUND * (high - low).max()
        size = torch.tensor([width, height], dtype=torch.float32)
        low, high = (low - margin).clamp(min=0), torch.minimum(high + margin, size)
        boxes[t] = torch.cat([torch.minimum(low, size - 1), torch.maximum(high, low + 1)])
    return boxes


def masks_by(mask: Mask, frames: Frames, boxes: Tensor, shots: NDArray[np.integer]) -> NDArray[np.uint8]:
    """The role's masks [T,H,W], 0 to 255, shot by shot.

    Args:
        mask: the role.
        frames: [T,H,W,3] sRGB.
        boxes: [T,4] of the subject.
        shots: [T].
    """
    soft = np.zeros(frames.shape[:3], np.uint8)
    for shot in dict.fromkeys(shots.tolist()):
        rows = np.flatnonzero(shots == shot)
        for piece in np.array_split(rows, -(-len(rows) // SHOT)):
            if bool(torch.isfinite(boxes[piece]).all(1).any()):
                found = mask(_pictures(frames[piece]), boxes[piece])
                soft[piece] = (255 * found[:, 0].clamp(0, 1)).round().to(torch.uint8).numpy()
    return soft


def heads_by(head: Head, frames: Frames, visible: Frames) -> Frames:
    """The role's head masks [T,H,W], 0 to 255, nowhere above the visible person's [T,H,W]."""
    heads = np.zeros_like(visible)
    for start in range(0, len(frames), PIECE):
        rows = slice(start, start + PIECE)
        found = head(_pictures(frames[rows]), torch.from_numpy(visible[rows])[:, None].float() / 255)
        heads[rows] = np.minimum((255 * found[:, 0].clamp(0, 1)).round().to(torch.uint8).numpy(), visible[rows])
    return heads


def fit_by(
    pose: Pose,
    frames: Frames,
    boxes: Tensor,
    body: BodyModel,
    seen: Observations,
    progress: Callable[[int, int, str], None],
) -> Fit:
    """The role's bodies as a fit of ours, held against the landmarks as our own fit is.

    Args:
        pose: the role.
        frames: [N,H,W,3], those in which the tracker found the subject.
        boxes: [N,4].
        body: the body wanted.
        seen: the landmarks of these frames; for the error that is reported.
        progress: called with frames done and in total.

    Raises:
        ValueError: the role finds nobody in any of these frames.
    """
    parts = []
    for start in range(0, len(frames), PIECE):
        progress(start, len(frames), "estimating poses")
        rows = slice(start, start + PIECE)
        parts.append(pose(_pictures(frames[rows]), seen.K.float(), boxes[rows]))
    estimate = _joined(parts)
    adopted = adopt(estimate, body)
    with torch.no_grad():
        landmarks = keypoints(body, body(adopted.pose, adopted.betas[None], adopted.transl))
    offsets = image_offsets(landmarks.to(seen.points), seen, person_depth(landmarks.to(seen.points)))
    error = offsets.norm(dim=-1)
    return Fit(
        pose=adopted.pose,
        transl=adopted.transl,
        betas=adopted.betas,
        landmarks=landmarks.double(),
        landmark_confidence=_confidence(estimate, landmarks),
        image_error=float((seen.visible * error).sum() / seen.visible.sum().clamp_min(1e-6)),
        costs={},
    )


def _confidence(estimate: PoseEstimate, landmarks: Tensor) -> Tensor:
    """[N,33] in [0,1]: by the model's own doubt about the joints nearest to each landmark; 0 where nobody was found."""
    joints = estimate.joints[..., [0, 2, 1]] * estimate.joints.new_tensor([1.0, 1.0, -1.0])  # camera -> world axes
    nearest = torch.cdist(landmarks.float(), joints).argmin(2)
    doubt = estimate.uncertainty.gather(1, nearest)
    return torch.exp(-((doubt / AGREEMENT) ** 2)).double() * estimate.found[:, None]


def _joined(parts: list[PoseEstimate]) -> PoseEstimate:
    names = ("pose", "betas", "joints", "uncertainty", "found")
    return PoseEstimate(parts[0].family, *(torch.cat([getattr(part, name) for part in parts]) for name in names))


def _pictures(frames: Frames) -> Tensor:
    """[N,H,W,3] uint8 -> [N,3,H,W] in [0,1]."""
    return torch.from_numpy(np.ascontiguousarray(frames)).permute(0, 3, 1, 2).float() / 255
