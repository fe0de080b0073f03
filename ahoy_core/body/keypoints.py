"""The 33 BlazePose landmarks on the body: what a landmark network's output is compared with."""

from __future__ import annotations

from typing import Final

from torch import Tensor

from ahoy_core.body.model import BodyModel, BodyOutput

# MediaPipe's order; left and right are the person's.
LANDMARK_NAMES: Final = (
    "nose",
    "left_eye_inner",
    "left_eye",
    "left_eye_outer",
    "right_eye_inner",
    "right_eye",
    "right_eye_outer",
    "left_ear",
    "right_ear",
    "mouth_left",
    "mouth_right",
    "left_shoulder",
    "right_shoulder",
    "left_elbow",
    "right_elbow",
    "left_wrist",
    "right_wrist",
    "left_pinky",
    "right_pinky",
    "left_index",
    "right_index",
    "left_thumb",
    "right_thumb",
    "left_hip",
    "right_hip",
    "left_knee",
    "right_knee",
    "left_ankle",
    "right_ankle",
    "left_heel",
    "right_heel",
    "left_foot_index",
    "right_foot_index",
)


def keypoints(body: BodyModel, output: BodyOutput) -> Tensor:
    """The 33 BlazePose landmarks [B,33,3], world, metres, in MediaPipe's order (`LANDMARK_NAMES`).

    Each is a convex blend of vertices. Face and toes lie on the surface; shoulders, elbows, wrists, hips, knees, ankles
    and heels lie inside the limb, as annotators of COCO place them; pinky and index are the first knuckles, thumb the
    second.

    Args:
        body: the body that made `output` (or the `subset` that holds all landmark vertices).
        output: its vertices [B,V,3].

    Raises:
        ValueError: when `output` lacks vertices that landmarks need.
    """
    indices = body.landmark_indices
    if int(indices.min()) < 0 or int(indices.max()) >= output.vertices.shape[1]:
        raise ValueError("expected all landmark vertices, got a subset; keep body.landmark_indices.unique() in it")
    picked = output.vertices[:, indices.flatten()].unflatten(1, indices.shape)
    return (picked * body.landmark_weights[..., None]).sum(2)
