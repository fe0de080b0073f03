"""Means of an avatar's scores before true cameras, driven by the true body: for sweeps and benchmarks.

The stage `evaluate` keeps every picture and row; here only means are wanted, by the same renderer and the same metrics.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ahoy_core.avatar.avatar import Avatar
from ahoy_core.body.model import BodyModel
from ahoy_core.captures.capture import Capture, View
from ahoy_core.formats.images import contact_sheet, to_uint8, write_png
from ahoy_core.metrics.perceptual import Perceptual
from ahoy_core.metrics.protocol import PROTOCOLS
from ahoy_core.metrics.regions import mask_box
from ahoy_core.metrics.score import Score, score_picture
from tasks.evaluation.renderers import AvatarRenderer
from tasks.evaluation.truths import Shot, Truths

_PROTOCOL = {"view": "novel-view-gt", "pose": "novel-pose-gt"}
_MARGIN = 6  # pixels shown round the person


@dataclass(frozen=True)
class AvatarScores:
    """Means over pictures: PSNR in dB of the person's box and of the head's (NaN where none is seen), SSIM, IoU.

    `perceptual` is the mean distance of the boxes by the network that was asked, None without one.
    """

    psnr: float
    psnr_head: float
    ssim: float
    iou: float
    pictures: int
    perceptual: float | None = None


def score_avatar(
    avatar: Avatar,
    body: BodyModel,
    capture: Capture,
    views: Sequence[View],
    size: int = 256,
    sheet: Path | None = None,
    perceptual: Perceptual | None = None,
) -> AvatarScores:
    """Render and score an avatar at true pictures of a capture.

    Args:
        avatar: who.
        body: that it stands on.
        capture: whose truth.
        views: of the moments "view" and "pose", of any camera.
        size: longest side of what is compared, pixels.
        sheet: where to put a picture of truths and renders, if anywhere.
        perceptual: network that compares the boxes, if any.

    Raises:
        ValueError: no true picture shows anybody.
    """
    truths, renderer = Truths(capture, None, size, None), AvatarRenderer(avatar, body, capture, None)
    found: list[dict[str, Score]] = []
    pictures = []
    for view in views:
        protocol = _PROTOCOL[view.moment]
        if (shot := truths.shot(protocol, view)) is None:
            continue
        made = renderer(shot)
        scores = score_picture(made, shot.truth, PROTOCOLS[protocol].pixels, perceptual)
        found.append({score.region: score for score in scores})
        pictures += [_cut(shot, None), _cut(shot, to_uint8(made.rgb))]
    if not found:
        raise ValueError(f"expected true pictures of {capture.name} that show somebody, got none of {len(views)}")
    if sheet is not None:
        write_png(sheet, contact_sheet(pictures, columns=8, cell=256))
    distances = [one["box"].perceptual for one in found if "box" in one]
    known = [distance for distance in distances if distance is not None]
    boxes, heads = ([one[name] for one in found if name in one] for name in ("box", "head"))
    return AvatarScores(
        float(np.mean([score.psnr for score in boxes])),
        float(np.mean([score.psnr for score in heads])) if heads else float("nan"),
        float(np.mean([score.ssim for score in boxes if score.ssim is not None])),
        float(np.mean([score.iou for score in boxes if score.iou is not None])),
        len(found),
        float(np.mean(known)) if known else None,
    )


def _cut(shot: Shot, image: np.ndarray | None) -> np.ndarray:
    x0, y0, x1, y1 = mask_box(shot.truth.alpha, _MARGIN)
    if image is None:
        image = to_uint8(shot.truth.rgb * shot.truth.alpha + 0.5 * (1 - shot.truth.alpha))
    return image[y0:y1, x0:x1]
