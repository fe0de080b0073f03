"""The result of the stage perceive, and how it is put together."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ahoy_core.body.keypoints import keypoints
from ahoy_core.body.model import BodyModel
from ahoy_core.conventions import OBSERVED_VIEWMAT
from ahoy_core.perceive.config import PerceiveConfig
from ahoy_core.perceive.fit import Fit
from ahoy_core.perceive.landmarks import LandmarkTrack
from ahoy_core.perceive.masks import FrameMasks
from ahoy_core.perceive.timeline import frame_confidence, joint_confidence, ranges


@dataclass(frozen=True)
class Perception:
    """The arrays of the artifact "perceive" (storage_schema/artifacts.py), and `notes` for fit.json.

    Attributes:
        pose: [T,J,3] axis-angle, radians; joint 0 is the root in the world.
        transl: [T,3] metres, world.
        betas: [S], one shape for the video.
        expression: [T,E] in [0,1], neutral where no face was read.
        expression_confidence: [T] in [0,1], 0 where the face is unseen, turned away or too small.
        joint_confidence: [T,J] in [0,1].
        frame_confidence: [T] in [0,1].
        used: [T] a person was found and fitted in this frame; other frames hold poses in between.
        viewmat: [4,4] world -> camera, `OBSERVED_VIEWMAT`.
        K: [3,3] pixels.
        landmarks: [T,33,3] x, y in pixels and visibility in [0,1].
        visible: [T,H,W] uint8 alpha of the visible part of the person.
        amodal: [T,H,W] uint8, the whole person, hidden parts included: silhouette of the fitted body, and
            what is visible; in unused frames too.
        head: [T,H,W] uint8 alpha of the visible head with its hair.
        occluded: [T] share of the body's silhouette inside the picture that is not visible.
        box: [T,4] x0, y0, x1, y1 of the visible part; zeros where unused.
        notes: JSON: field of view and where it came from, residuals, what was skipped and why.
    """

    pose: NDArray[np.float32]
    transl: NDArray[np.float32]
    betas: NDArray[np.float32]
    expression: NDArray[np.float32]
    expression_confidence: NDArray[np.float32]
    joint_confidence: NDArray[np.float32]
    frame_confidence: NDArray[np.float32]
    used: NDArray[np.bool_]
    viewmat: NDArray[np.float32]
    K: NDArray[np.float32]
    landmarks: NDArray[np.float32]
    visible: NDArray[np.uint8]
    amodal: NDArray[np.uint8]
    head: NDArray[np.uint8]
    occluded: NDArray[np.float32]
    box: NDArray[np.float32]
    notes: dict[str, Any]


def make_notes(
    config: PerceiveConfig,
    track: LandmarkTrack,
    fit: Fit,
    used: NDArray[np.bool_],
    masks: list[FrameMasks],
    K: NDArray[np.float64],
    size: tuple[int, int],
    given: bool,
    faces_read: int,
) -> dict[str, Any]:
    """What a reader of the report needs to know about the fit."""
    diagonal = 2 * math.degrees(math.atan(0.5 * math.hypot(*size) / math.sqrt(K[0, 0] * K[1, 1])))
    looked = np.zeros(len(used), np.bool_)
    looked[:: config.stride] = True
    skipped = (
        {}
        if faces_read
        else {"expression": "no face was seen large enough and from the front; expressions are neutral"}
    )
    return {
        "fov_degrees": round(diagonal, 2),
        "fov_from": "given" if given else "assumed",
        "people": track.people,
        "subject": config.subject,
        "frames": len(used),
        "frames_used": int(used.sum()),
        "frames_without_person": ranges(looked & ~used),
        "frames_left_out_by_stride": int((~looked).sum()),
        "landmark_error_m": round(fit.image_error, 4),
        "costs": fit.costs,
        "betas": [round(float(b), 4) for b in fit.betas],
        "occluded": [round(m.occluded, 3) for m in masks],
        "occluded_mean": round(float(np.mean([m.occluded for m, u in zip(masks, used, strict=True) if u])), 3),
        "faces_read": faces_read,
        "skipped": skipped,
    }


def assemble_result(
    body: BodyModel,
    track: LandmarkTrack,
    fit: Fit,
    used: NDArray[np.bool_],
    looked: NDArray[np.int64],
    pose: torch.Tensor,
    transl: torch.Tensor,
    masks: list[FrameMasks],
    heads: NDArray[np.uint8],
    faces: tuple[NDArray[np.float32], NDArray[np.float32]],
    K: NDArray[np.float64],
    notes: dict[str, Any],
) -> Perception:
    """Put everything into the artifact's arrays."""
    n = len(used)
    with torch.no_grad():
        rest = body(torch.zeros(1, body.n_joints, 3), fit.betas[None], torch.zeros(1, 3))
        joints = joint_confidence(keypoints(body, rest)[0], rest.rest_joints[0], fit.landmark_confidence)
    by_joint, by_frame = np.zeros((n, body.n_joints), np.float32), np.zeros(n, np.float32)
    by_joint[used], by_frame[used] = joints.numpy(), frame_confidence(fit.landmark_confidence).numpy()
    landmarks = np.zeros((n, *track.landmarks.shape[1:]), np.float32)
    landmarks[looked, :, :2], landmarks[looked, :, 2] = track.landmarks[..., :2], track.visibility
    return Perception(
        pose=pose.numpy().astype(np.float32),
        transl=transl.numpy().astype(np.float32),
        betas=fit.betas.numpy().astype(np.float32),
        expression=faces[0],
        expression_confidence=faces[1],
        joint_confidence=by_joint,
        frame_confidence=by_frame,
        used=used,
        viewmat=OBSERVED_VIEWMAT.numpy().astype(np.float32),
        K=K.astype(np.float32),
        landmarks=landmarks,
        visible=np.stack([m.visible for m in masks]),
        amodal=np.stack([m.amodal for m in masks]),
        head=heads,
        occluded=np.array([m.occluded for m in masks], np.float32),
        box=np.stack([m.box for m in masks]),
        notes=notes,
    )
