"""Scores of an avatar before the true cameras of a capture, driven by the true body (novel view and novel pose)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ahoy_core.avatar.avatar import Avatar
from ahoy_core.avatar.head import body_shares, head_reach, head_zone
from ahoy_core.avatar.kinematics import Kinematics
from ahoy_core.avatar.render import render
from ahoy_core.body.packaged import PackagedBody
from ahoy_core.body.rotations import axis_angle_to_matrix
from ahoy_core.conventions import GREY
from ahoy_core.formats.images import contact_sheet, to_float, to_uint8, write_png
from ahoy_core.metrics import iou, psnr
from ahoy_core.metrics.regions import mask_box
from benchmarks.captures import Capture


@torch.no_grad()
def scores(
    capture: Capture,
    body: PackagedBody,
    avatar: Avatar,
    poses: Tensor,
    places: Tensor,
    frames: Sequence[int],
    cameras: Sequence[str],
    kind: str = "gt",
    sheet: Path | None = None,
) -> dict[str, float]:
    """PSNR in the mask's box, PSNR in the head's box and silhouette IoU, each the mean over frames and cameras.

    Over grey 0.5, at the capture's size. The head's box is that of the head zone of the bare true body.

    Args:
        capture: Whose truth.
        body: The body.
        avatar: Who is scored.
        poses: [T,J,3] true poses of the motion `kind`.
        places: [T,3].
        frames: Numbers of frames.
        cameras: Names of cameras.
        kind: "gt" or "novel", the folder of the true pictures.
        sheet: Where to put a picture of truth and render, if anywhere.
    """
    kinematics = Kinematics.of(body, avatar.betas)
    rows, pictures = [], []
    for frame in frames:
        posed = avatar.pose(body, poses[frame], places[frame])
        relative = kinematics.relative(axis_angle_to_matrix(poses[frame])[None], places[frame][None])[0]
        for name in cameras:
            camera = capture.cameras[name]
            truth = to_float(capture.truth(name, frame, kind))
            alpha = truth[3]
            target = truth[:3] * alpha + GREY * (1 - alpha)
            made = render(posed.means, posed.covars, posed.opacities, posed.colors, camera, GREY)
            image = made.images[0].clamp(0, 1)
            shares = body_shares(avatar.template, relative, camera)[0]
            zone = head_zone(shares, head_reach(kinematics, avatar.template, relative, camera))
            rows.append(
                [_box_psnr(image, target, alpha), _box_psnr(image, target, zone), iou(made.alphas[0, 0], alpha)]
            )
            pictures += [_cut(target, alpha), _cut(image, alpha)]
    if sheet is not None:
        write_png(sheet, contact_sheet(pictures, columns=2 * len(cameras), cell=256))
    mean = np.mean(rows, axis=0)
    return {"psnr": round(float(mean[0]), 2), "psnr_head": round(float(mean[1]), 2), "iou": round(float(mean[2]), 4)}


def _box_psnr(image: Tensor, target: Tensor, mask: Tensor) -> float:
    x0, y0, x1, y1 = mask_box(mask)
    return psnr(image[:, y0:y1, x0:x1], target[:, y0:y1, x0:x1])


def _cut(image: Tensor, alpha: Tensor) -> np.ndarray:
    x0, y0, x1, y1 = mask_box(alpha, 6)
    return to_uint8(image)[y0:y1, x0:x1]
