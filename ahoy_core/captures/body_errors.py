"""How far perception is from the true body and the true masks of a capture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from ahoy_core.body.packaged import PackagedBody
from ahoy_core.captures.capture import Capture, true_joints
from ahoy_core.captures.files import read_mask
from ahoy_core.captures.fit import Clip

# The captures' 24 joints (SMPL's order) and the joint of the packaged body at the same place; `breast.L` and spine01
# start where spine3 is.
JOINTS24 = {
    "pelvis": "root", "l_hip": "upperleg01.L", "r_hip": "upperleg01.R", "spine1": "spine04", "l_knee": "lowerleg01.L",
    "r_knee": "lowerleg01.R", "spine2": "spine02", "l_ankle": "foot.L", "r_ankle": "foot.R", "spine3": "breast.L",
    "l_foot": "toe1-1.L", "r_foot": "toe1-1.R", "neck": "neck01", "l_collar": "clavicle.L", "r_collar": "clavicle.R",
    "head": "head", "l_shoulder": "upperarm01.L", "r_shoulder": "upperarm01.R", "l_elbow": "lowerarm01.L",
    "r_elbow": "lowerarm01.R",
    "l_wrist": "wrist.L", "r_wrist": "wrist.R", "l_hand": "finger3-1.L", "r_hand": "finger3-1.R",
}  # fmt: skip

HALF = 127  # of 255
_SLACK = np.ones((5, 5), np.uint8)


Found = Mapping[str, NDArray[np.generic]]
"""What perception found: pose, betas, transl, viewmat, and the masks visible and amodal."""


def body_errors(
    capture: Capture, clip: Clip, body: PackagedBody, found: Found, frames: Sequence[int] | None = None
) -> dict[str, float | None]:
    """Errors of the bodies and masks that were found.

    Joints are `JOINTS24`, errors in the camera's axes. `mpjpe_mm` is about the root; `pa_` after the best similarity of
    each frame, over joints that are on the visible part of the person (two pixels of slack) and over the others.
    `root_mm` is the distance of the root, `root_depth_mm` and `root_across_mm` the means of its parts along the
    camera's axis and across it, without sign; `root_depth_bias_mm` keeps the sign. `jitter` is the mean second
    difference of the joints, in mm/frame^2. None where nothing is hidden, or no true mask is there.

    Args:
        capture: whose truth.
        clip: its input.
        body: that was fitted.
        found: of T frames.
        frames: number of each in the input; the first T by default.
    """
    numbers = list(range(len(found["pose"])) if frames is None else map(int, frames))
    seen, camera = clip.visible[numbers] > HALF, capture.cameras[capture.input_camera]
    K, view = camera.Ks[0].double().numpy(), camera.viewmats[0].double().numpy()
    rows = [body.joint_names.index(name) for name in JOINTS24.values()]
    joints = true_joints(capture.bodies["view"])[numbers][:, rows].double().numpy()
    truth = joints @ view[:3, :3].T + view[:3, 3]
    ours = _found_joints(body, found)
    visible = _visible(truth, K, seen)
    errors = aligned_errors(ours, truth) * 1000
    centred = np.linalg.norm((ours - ours[:, :1]) - (truth - truth[:, :1]), axis=-1) * 1000
    root = (ours - truth)[:, 0] * 1000
    return {
        "mpjpe_mm": round(float(centred.mean()), 1),
        "pa_mpjpe_mm": round(float(errors.mean()), 1),
        "pa_mpjpe_visible_mm": round(float(errors[visible].mean()), 1),
        "pa_mpjpe_hidden_mm": round(float(errors[~visible].mean()), 1) if (~visible).any() else None,
        **_mask_scores(capture, seen, found, numbers),
        "root_mm": round(float(np.linalg.norm(root, axis=1).mean()), 1),
        "root_depth_mm": round(float(np.abs(root[:, 2]).mean()), 1),
        "root_depth_bias_mm": round(float(root[:, 2].mean()), 1),
        "root_across_mm": round(float(np.linalg.norm(root[:, :2], axis=1).mean()), 1),
        "jitter": round(jitter(ours) * 1000, 2),
        "jitter_gt": round(jitter(truth) * 1000, 2),
    }


def aligned_errors(ours: NDArray[np.floating], truth: NDArray[np.floating]) -> NDArray[np.float64]:
    """Distances [T,J] after the best similarity of each frame, same unit as the input [T,J,3]."""
    errors = []
    for a, b in zip(ours.astype(np.float64), truth.astype(np.float64), strict=True):
        a, b = a - a.mean(0), b - b.mean(0)
        u, s, vt = np.linalg.svd(a.T @ b)
        sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
        errors.append(np.linalg.norm((s * sign).sum() / (a**2).sum() * a @ ((u * sign) @ vt) - b, axis=1))
    return np.stack(errors)


def jitter(joints: NDArray[np.floating]) -> float:
    """Mean second difference of joints [T,J,3], the input's unit per frame^2."""
    return float(np.linalg.norm(np.diff(joints, 2, axis=0), axis=-1).mean()) if len(joints) > 2 else 0.0


def _found_joints(body: PackagedBody, found: Found) -> NDArray[np.float64]:
    """`JOINTS24` [T,24,3] on the fitted body, in the camera's axes."""
    rows = [body.joint_names.index(name) for name in JOINTS24.values()]
    pose, betas, transl = (torch.from_numpy(x) for x in (found["pose"], found["betas"], found["transl"]))
    with torch.no_grad():
        joints = torch.cat([body(pose[t, None], betas[None], transl[t, None]).joints for t in range(len(pose))])
    view = found["viewmat"].astype(np.float64)
    return np.asarray(joints[:, rows].double().numpy() @ view[:3, :3].T + view[:3, 3])


def _mask_scores(
    capture: Capture, seen: NDArray[np.bool_], found: Found, numbers: Sequence[int]
) -> dict[str, float | None]:
    visible, amodal = (found[name].astype(np.int32) > HALF for name in ("visible", "amodal"))
    paths = [capture.folder / "amodal" / f"{number:03d}.png" for number in numbers]
    whole = [_overlap(mask, read_mask(path) > HALF) for mask, path in zip(amodal, paths, strict=True) if path.exists()]
    return {
        "mask_iou": round(float(np.mean([_overlap(a, b) for a, b in zip(visible, seen, strict=True)])), 4),
        "amodal_iou": round(float(np.mean(whole)), 4) if whole else None,
    }


def _overlap(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> float:
    return float((a & b).sum() / max((a | b).sum(), 1))


def _visible(truth: NDArray[np.floating], K: NDArray[np.floating], seen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Whether each joint [T,J] projects onto the visible part of the person."""
    pixels = truth @ K.T
    pixels = np.floor(pixels[..., :2] / pixels[..., 2:]).astype(int)
    result = np.zeros(truth.shape[:2], np.bool_)
    for t, mask in enumerate(seen):
        grown = cv2.dilate(mask.astype(np.uint8), _SLACK)
        inside = ((pixels[t] >= 0) & (pixels[t] < np.array(mask.shape[::-1]))).all(1)
        x, y = pixels[t][inside].T
        result[t, inside] = grown[y, x] > 0
    return result
