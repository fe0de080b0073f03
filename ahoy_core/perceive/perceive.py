"""From frames to a body over time, and masks (paper section 3.1, first half: (theta_t, beta) and M_t)."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ahoy_core.body.model import BodyModel
from ahoy_core.body.regions import faces_within
from ahoy_core.conventions import OBSERVED_VIEWMAT
from ahoy_core.perceive.config import PerceiveConfig
from ahoy_core.perceive.face import FaceReading, expressions, read_face
from ahoy_core.perceive.filled import Filled, fit_by, heads_by, masks_by, subject_boxes
from ahoy_core.perceive.fit import fit_body
from ahoy_core.perceive.head import head_mask
from ahoy_core.perceive.landmarks import LandmarkTrack, run_landmarks
from ahoy_core.perceive.masks import frame_masks, refine, silhouette
from ahoy_core.perceive.networks import Networks
from ahoy_core.perceive.objective import FitConfig
from ahoy_core.perceive.observe import observations
from ahoy_core.perceive.perception import Perception, assemble_result, make_notes
from ahoy_core.perceive.static import hold_static
from ahoy_core.perceive.timeline import spread_poses
from ahoy_core.perceive.tracking import NoPersonError
from ahoy_core.texture.rays import to_camera

__all__ = ["NoPersonError", "PerceiveConfig", "Perception", "assumed_intrinsics", "perceive"]

Progress = Callable[[int, int, str], None]
# Shares of the stage's time, for one progress bar over its parts; in thousandths.
BAR = 1000
BAR_LANDMARKS, BAR_MASKS, BAR_FIT = 500, 600, 900
EMBEDDED = Filled()
NOSE, SEEN_NOSE = 0, 0.5  # the landmark and its visibility from which a face is looked for


def perceive(
    frames: NDArray[np.uint8],
    pts: NDArray[np.floating],
    shots: NDArray[np.integer],
    K: NDArray[np.floating] | None,
    body: BodyModel,
    networks: Networks,
    config: PerceiveConfig,
    progress: Progress | None = None,
    viewmat: NDArray[np.floating] | None = None,
    filled: Filled = EMBEDDED,
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
        viewmat: [4,4] where a still camera stands, if known: from a world with z up and the floor at z = 0. The result
            stays in the axes of `OBSERVED_VIEWMAT`.
        filled: models that fill roles instead of the embedded defaults.

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
    boxes = subject_boxes(track, looked, n, height, width)

    def cutting(done: int, total: int) -> None:
        report(BAR_LANDMARKS + (BAR_MASKS - BAR_LANDMARKS) * done // total, BAR, "cutting the person out")

    if filled.mask is not None:
        cutting(0, 1)
        soft = masks_by(filled.mask, frames, boxes, shots)
    else:
        soft = _soft_masks(frames, track, looked, used, shots, config, cutting)
    seen = observations(track, pts[looked], shots[looked], intrinsics, viewmat, config)
    knobs = FitConfig(iterations=config.iterations, smoothing=config.smoothing, outline=config.outline)

    def fitting(done: int, total: int, note: str) -> None:
        report(BAR_MASKS + (BAR_FIT - BAR_MASKS) * done // total, BAR, note)

    if filled.pose is not None:
        fit = fit_by(filled.pose, frames[used], boxes[used], body, seen, fitting)
    else:
        fit = fit_body(body, seen, knobs, fitting, soft[used])
    pose, transl = spread_poses(fit.pose, fit.transl, used, pts, shots)
    faces = _faces(networks, frames, track, looked, body.n_expressions)
    head = faces_within(body.faces, body.regions["head"]).numpy()
    masks, heads = [], np.zeros_like(soft)
    for t in range(n):
        with torch.no_grad():
            vertices = body(pose[t][None], fit.betas[None], transl[t][None]).vertices[0].numpy()
        masks.append(frame_masks(soft[t], silhouette(vertices, body.faces.numpy(), intrinsics, height, width)))
        if used[t] and filled.head is None:
            seen_from = to_camera(vertices, OBSERVED_VIEWMAT.numpy())
            heads[t] = head_mask(seen_from, body.faces.numpy(), head, intrinsics, masks[t].visible)
        report(BAR_FIT + (BAR - BAR_FIT) * (t + 1) // n, BAR, "drawing the silhouettes")
    if filled.head is not None:
        heads[used] = heads_by(filled.head, frames[used], np.stack([m.visible for m in masks])[used])
    read = int((faces[1] > 0).sum())
    notes = make_notes(config, track, fit, used, masks, intrinsics, (height, width), K is not None, read)
    return assemble_result(body, track, fit, used, looked, pose, transl, masks, heads, faces, intrinsics, notes)


def _soft_masks(
    frames: NDArray[np.uint8],
    track: LandmarkTrack,
    looked: NDArray[np.int64],
    used: NDArray[np.bool_],
    shots: NDArray[np.integer],
    config: PerceiveConfig,
    report: Callable[[int, int], None],
) -> NDArray[np.uint8]:
    """The embedded role "mask": the landmark network's, with edges moved to the picture's, [T,H,W], 0 to 255."""
    soft = np.zeros(frames.shape[:3], np.uint8)
    for row, t in enumerate(looked.tolist()):
        roi = track.rois[row]
        if roi is not None:
            mask = track.mask(row, *frames.shape[1:3])
            soft[t] = refine(frames[t], mask, roi.size) if config.mask_refinement else np.round(255 * mask)
        report(row + 1, len(looked))
    if config.mask_refinement:
        soft[used] = hold_static(frames[used], soft[used], shots[used])
    return soft


def _faces(
    networks: Networks, frames: NDArray[np.uint8], track: LandmarkTrack, looked: NDArray[np.int64], actions: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Facial actions [T,E] and confidence [T]; frames that were not looked at are neutral."""
    readings: list[FaceReading | None] = [None] * len(frames)
    for row, t in enumerate(looked.tolist()):
        if track.found[row] and track.visibility[row, NOSE] > SEEN_NOSE:
            readings[t] = read_face(networks, frames[t], track.landmarks[row, :, :2])
    return expressions(readings, actions)


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
