"""The references that sweeps compare with: what a stage left in a folder, against a capture's truth."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

import numpy as np

from ahoy_core.avatar.avatar import Avatar
from ahoy_core.avatar.files import load_avatar
from ahoy_core.body.packaged import load_packaged_body
from ahoy_core.captures.body_errors import body_errors
from ahoy_core.captures.capture import Capture
from ahoy_core.captures.fit import read_clip, true_fit
from ahoy_core.captures.texture_errors import texture_errors
from ahoy_core.formats.npz import load_npz
from tasks.evaluation.scoring import score_avatar
from tasks.fills import Fills
from tasks.roles import perceptual_network

SHARPNESS_DB: Final = 20.0
"""Decibels that one unit of perceptual distance is worth: a hundredth counts as 0.2 dB. Without it no knob would ever
be worth its time: where a fit is a pixel off, blur has the better PSNR."""

FolderErrors = Callable[[Capture, Mapping[str, Path], Path], Mapping[str, float]]
"""Errors (smaller is better) of a stage's output folder, given the capture and the folders of its inputs."""


def perceived(capture: Capture, inputs: Mapping[str, Path], made: Path) -> Mapping[str, float]:
    """Joints in mm after the best similarity of each frame, root in mm, masks as 1 - IoU."""
    index = load_npz(inputs["ingest"] / "frames.npz", ["index"])["index"]
    masks = load_npz(made / "masks.npz", ["visible", "amodal"])
    found = {**load_npz(made / "body.npz"), **masks}
    errors = body_errors(capture, read_clip(capture), load_packaged_body(), found, index.tolist())
    kept = {name: errors[name] for name in ("pa_mpjpe_mm", "pa_mpjpe_visible_mm", "pa_mpjpe_hidden_mm", "root_mm")}
    lost = {f"{name}_loss": 1 - value for name in ("mask_iou", "amodal_iou") if (value := errors[name]) is not None}
    return {name: value for name, value in {**kept, **lost}.items() if value is not None}


def textured(capture: Capture, inputs: Mapping[str, Path], made: Path) -> Mapping[str, float]:
    """Mean absolute difference, of 255, of seen texels and of those that were never seen."""
    body = load_packaged_body()
    found = texture_errors(capture, body, true_fit(capture, body), load_npz(made / "atlas.npz"))
    return {"texel_l1": found["texel_l1"], "unseen_l1": float(np.mean(list(found["unseen_l1"].values())))}


def rendered(capture: Capture, inputs: Mapping[str, Path], made: Path) -> Mapping[str, float]:
    """Root mean square error, of 255, before all true cameras at the input's moments: person's box and head's box."""
    scores = score_avatar(load_avatar(made), load_packaged_body(), capture, capture.of("view"))
    return {"rmse": rmse(scores.psnr), "head_rmse": rmse(scores.psnr_head), "iou_loss": 1 - scores.iou}


def whole_errors(avatar: Avatar, capture: Capture, size: int) -> Mapping[str, float]:
    """Root mean square errors, of 255, of an avatar driven by the true body, before cameras that are not the input's.

    `rmse` stands for the mean PSNR of novel views and novel poses, which `view_rmse` and `pose_rmse` give apart.
    Blur is cheap in it; `ssim_loss` (1 - SSIM) and `perceptual` (of the network that fills the role, where one does)
    say what sharpness is worth.
    """
    views, poses = ([v for v in capture.of(m) if v.camera != capture.input_camera] for m in ("view", "pose"))
    network, body = perceptual_network(Fills()), load_packaged_body()
    view, pose = (score_avatar(avatar, body, capture, some, size, perceptual=network) for some in (views, poses))
    found = {
        "rmse": rmse((view.psnr + pose.psnr) / 2),
        "view_rmse": rmse(view.psnr),
        "pose_rmse": rmse(pose.psnr),
        "head_rmse": rmse(view.psnr_head),
        "ssim_loss": 1 - (view.ssim + pose.ssim) / 2,
    }
    if view.perceptual is not None and pose.perceptual is not None:
        found["perceptual"] = (view.perceptual + pose.perceptual) / 2
    return found


def rmse(psnr: float) -> float:
    """Levels of 255 that a PSNR in dB (peak 1) stands for."""
    return float(255 * 10 ** (-psnr / 20))


def gain(errors: Mapping[str, float], base: Mapping[str, float]) -> float:
    """How much more accurate a whole run is than another: dB of PSNR, and `SHARPNESS_DB` where both were compared so.

    Args:
        errors: of `whole_errors`.
        base: likewise, of the other.
    """
    found = psnr(errors["rmse"]) - psnr(base["rmse"])
    if "perceptual" in errors and "perceptual" in base:
        found += SHARPNESS_DB * (base["perceptual"] - errors["perceptual"])
    return found


def psnr(levels: float) -> float:
    """Inverse of `rmse`."""
    return float(-20 * np.log10(max(levels, 1e-9) / 255))
