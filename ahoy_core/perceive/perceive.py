"""From frames to a body over time, and masks (paper section 3.1, first half: (theta_t, beta) and M_t)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from ahoy_core.body.keypoints import keypoints
from ahoy_core.body.model import BodyModel
from ahoy_core.conventions import OBSERVED_VIEWMAT
from ahoy_core.perceive.fit import Fit, FitConfig, fit_body
from ahoy_core.perceive.landmarks import LandmarkTrack, run_landmarks
from ahoy_core.perceive.masks import FrameMasks, frame_masks, refine, silhouette
from ahoy_core.perceive.networks import Networks
from ahoy_core.perceive.residuals import Observations
from ahoy_core.perceive.static import hold_static
from ahoy_core.perceive.timeline import frame_confidence, joint_confidence, ranges, spread_poses
from ahoy_core.perceive.tracking import NoPersonError

__all__ = ["NoPersonError", "PerceiveConfig", "Perception", "assumed_intrinsics", "perceive"]

Progress = Callable[[int, int, str], None]
# Shares of the stage's time, for one progress bar over its parts; in thousandths.
BAR = 1000
BAR_LANDMARKS, BAR_MASKS, BAR_FIT = 500, 600, 900


class PerceiveConfig(BaseModel):
    """Knobs of the stage.

    Attributes:
        model: the landmark network that fills the roles pose and mask.
        passes: readings averaged per frame: 1 forward, 2 also mirrored, 3 also backward in time, 4 backward mirrored
            too.
        stride: look at every stride-th frame; the others get poses in between and count as unused.
        subject: number of the person, 0 the most prominent; None: the most prominent of each shot.
        iterations: most steps in each of the fit's stages; it stops earlier when nothing is gained.
        smoothing: weight of accelerations in the fit.
        fov_degrees: diagonal field of view assumed where no camera is given.
        outline: weight of the masks' outlines in the fit; 0: landmarks alone.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    model: Literal["pose_landmark_full"] = "pose_landmark_full"
    passes: Literal[1, 2, 3, 4] = 2
    stride: int = Field(default=1, ge=1, le=100)
    subject: int | None = Field(default=None, ge=0)
    iterations: int = Field(default=10, ge=1, le=1000)
    smoothing: float = Field(default=1.0, ge=0.0, le=1000.0)
    fov_degrees: float = Field(default=50.0, gt=5.0, lt=150.0)
    outline: float = Field(default=1.0, ge=0.0, le=1000.0)


@dataclass(frozen=True)
class Perception:
    """The arrays of the artifact "perceive" (storage_schema/artifacts.py), and `notes` for fit.json.

    Attributes:
        pose: [T,J,3] axis-angle, radians; joint 0 is the root in the world.
        transl: [T,3] metres, world.
        betas: [S], one shape for the video.
        expression: [T,E], neutral.
        expression_confidence: [T], 0: no network reads the face yet.
        joint_confidence: [T,J] in [0,1].
        frame_confidence: [T] in [0,1].
        used: [T] a person was found and fitted in this frame; other frames hold poses in between.
        viewmat: [4,4] world -> camera, `OBSERVED_VIEWMAT`.
        K: [3,3] pixels.
        landmarks: [T,33,3] x, y in pixels and visibility in [0,1].
        visible: [T,H,W] uint8 alpha of the visible part of the person.
        amodal: [T,H,W] uint8 silhouette of the fitted body, in unused frames too.
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
    box: NDArray[np.float32]
    notes: dict[str, Any]


def perceive(
    frames: NDArray[np.uint8],
    pts: NDArray[np.floating],
    shots: NDArray[np.integer],
    K: NDArray[np.floating] | None,
    body: BodyModel,
    networks: Networks,
    config: PerceiveConfig,
    progress: Progress | None = None,
) -> Perception:
    """Find the subject, fit the body over the whole clip, and cut the person out.

    Args:
        frames: [T,H,W,3] uint8 sRGB.
        pts: [T] seconds, rising within a shot.
        shots: [T] shot numbers.
        K: [3,3] intrinsics in pixels of these frames, or None to assume a field of view.
        body: the body to fit.
        networks: the landmark networks.
        config: the knobs.
        progress: called with thousandths done, 1000, and a note.

    Raises:
        ValueError: arrays of other shapes than stated.
        NoPersonError: no person in any frame, or no such subject.
    """
    _check(frames, pts, shots, K)
    report = progress or (lambda done, total, note: None)
    n, height, width = frames.shape[:3]
    looked = np.arange(0, n, config.stride)
    track = run_landmarks(
        networks,
        frames[looked],
        shots[looked],
        subject=config.subject,
        passes=config.passes,
        progress=lambda done, total, note: report(BAR_LANDMARKS * done // total, BAR, note),
    )
    if not track.found.any():
        raise NoPersonError(
            f"expected a person in at least one of {len(looked)} frames, got none that the landmark network confirms; "
            "use a clip in which a person is larger or better lit"
        )
    intrinsics = assumed_intrinsics(height, width, config.fov_degrees) if K is None else np.asarray(K, np.float64)
    used = np.zeros(n, np.bool_)
    used[looked[track.found]] = True
    soft = np.zeros((n, height, width), np.uint8)
    for row, t in enumerate(looked.tolist()):
        roi = track.rois[row]
        if roi is not None:
            soft[t] = refine(frames[t], track.mask(row, height, width), roi.size)
        report(BAR_LANDMARKS + (BAR_MASKS - BAR_LANDMARKS) * (row + 1) // len(looked), BAR, "cutting the person out")
    soft[used] = hold_static(frames[used], soft[used], shots[used])
    fit = fit_body(
        body,
        _observations(track, pts[looked], shots[looked], intrinsics),
        FitConfig(iterations=config.iterations, smoothing=config.smoothing, outline=config.outline),
        lambda done, total, note: report(BAR_MASKS + (BAR_FIT - BAR_MASKS) * done // total, BAR, note),
        soft[used],
    )
    pose, transl = spread_poses(fit.pose, fit.transl, used, pts, shots)
    masks = []
    for t in range(n):
        amodal = _amodal(body, pose[t], transl[t], fit.betas, intrinsics, height, width)
        masks.append(frame_masks(soft[t], amodal))
        report(BAR_FIT + (BAR - BAR_FIT) * (t + 1) // n, BAR, "drawing the silhouettes")
    notes = _notes(config, track, fit, used, masks, intrinsics, (height, width), K is not None)
    return _assemble(body, track, fit, used, looked, pose, transl, masks, intrinsics, notes)


def assumed_intrinsics(height: int, width: int, fov_degrees: float) -> NDArray[np.float64]:
    """Return K [3,3] of a camera with square pixels, centred, with this field of view along the diagonal."""
    focal = 0.5 * math.hypot(height, width) / math.tan(math.radians(fov_degrees) / 2)
    return np.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])


def _check(frames: NDArray[np.uint8], pts: NDArray[Any], shots: NDArray[Any], K: NDArray[Any] | None) -> None:
    if frames.dtype != np.uint8 or frames.ndim != 4 or frames.shape[3] != 3 or len(frames) == 0:
        raise ValueError(f"expected frames of uint8 [T,H,W,3] with T > 0, got {frames.dtype} {frames.shape}")
    if pts.shape != (len(frames),) or shots.shape != (len(frames),):
        raise ValueError(f"expected pts and shots [{len(frames)}], one a frame, got {pts.shape} and {shots.shape}")
    if K is not None and (K.shape != (3, 3) or not K[0, 0] > 0 or not K[1, 1] > 0):
        raise ValueError(f"expected K [3,3] with positive focal lengths, got {K!r}; leave it out to assume a camera")


def _observations(
    track: LandmarkTrack, pts: NDArray[np.floating], shots: NDArray[np.integer], K: NDArray[np.float64]
) -> Observations:
    """Turn the found frames into tensors; camera axes become world axes."""
    found = track.found
    to_world = OBSERVED_VIEWMAT[:3, :3]  # rows times this matrix are the inverse rotation
    return Observations(
        points=torch.from_numpy(track.landmarks[found, :, :2]),
        # Visible landmarks score above .9 and hidden ones .4 to .8: the fourth power tells them apart.
        weights=torch.from_numpy(track.visibility[found]) ** 4,
        world=torch.from_numpy(track.world[found]) @ to_world,
        times=torch.from_numpy((pts[found] - pts[0]).astype(np.float64)),
        shot=torch.from_numpy(shots[found].astype(np.int64)),
        K=torch.from_numpy(K.astype(np.float32)),
    )


def _amodal(
    body: BodyModel, pose: torch.Tensor, transl: torch.Tensor, betas: torch.Tensor, K: NDArray[Any], h: int, w: int
) -> NDArray[np.uint8]:
    with torch.no_grad():
        vertices = body(pose[None], betas[None], transl[None]).vertices[0].numpy()
    return silhouette(vertices, body.faces.numpy(), K, h, w)


def _notes(
    config: PerceiveConfig,
    track: LandmarkTrack,
    fit: Fit,
    used: NDArray[np.bool_],
    masks: list[FrameMasks],
    K: NDArray[np.float64],
    size: tuple[int, int],
    given: bool,
) -> dict[str, Any]:
    """What a reader of the report needs to know about the fit."""
    diagonal = 2 * math.degrees(math.atan(0.5 * math.hypot(*size) / math.sqrt(K[0, 0] * K[1, 1])))
    looked = np.zeros(len(used), np.bool_)
    looked[:: config.stride] = True
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
        "skipped": {"expression": "no network of this stage reads the face; expressions are neutral"},
    }


def _assemble(
    body: BodyModel,
    track: LandmarkTrack,
    fit: Fit,
    used: NDArray[np.bool_],
    looked: NDArray[np.int64],
    pose: torch.Tensor,
    transl: torch.Tensor,
    masks: list[FrameMasks],
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
        expression=np.zeros((n, body.n_expressions), np.float32),
        expression_confidence=np.zeros(n, np.float32),
        joint_confidence=by_joint,
        frame_confidence=by_frame,
        used=used,
        viewmat=OBSERVED_VIEWMAT.numpy().astype(np.float32),
        K=K.astype(np.float32),
        landmarks=landmarks,
        visible=np.stack([m.visible for m in masks]),
        amodal=np.stack([m.amodal for m in masks]),
        box=np.stack([m.box for m in masks]),
        notes=notes,
    )
