"""What the coarse avatar is trained on, checked and cut out (paper section 3.1, equation 1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from ahoy_core.avatar.kinematics import relative_transforms
from ahoy_core.avatar.losses import LossWeights, canonical_weight
from ahoy_core.body.model import BodyModel
from ahoy_core.conventions import GREY, Cameras
from ahoy_core.metrics.regions import mask_box

# A mask with less area than this (in pixels) says nothing about appearance.
MIN_MASK_AREA = 16.0
_MARGIN = 4
# What is cut out goes this share of the picture's height further than the mask: there spikes can be seen and punished.
_MARGIN_SHARE = 0.03
# Alpha above which a mask speaks of a person, and the pixels around it that still may show one.
_TRACE = 0.05
_UNSURE = 2


@dataclass(frozen=True)
class CoarseInputs:
    """Everything equation 1 asks for.

    Attributes:
        body: The body model.
        betas: [S] shape.
        pose: [T,J,3] axis-angle; joint 0 in the world.
        transl: [T,3] metres, world.
        frames: [T,3,H,W] sRGB, uint8 or float32 in [0,1].
        masks: [T,H,W] alpha of the visible part of the subject, uint8 or float32 in [0,1].
        silhouettes: [T,H,W] alpha of the whole fitted body, hidden parts too, uint8 or float32 in [0,1].
        viewmat: [4,4] observed camera, world -> camera.
        K: [3,3] pixels of the frames.
        used: [T] bool, a person was fitted in the frame.
        confidence: [T] in [0,1], weight of each frame.
        views: [V,4,Hc,Wc] canonical views, RGBA with straight alpha, float32 in [0,1].
        view_coverage: [V,Hc,Wc] observed share of each pixel, [0,1].
        view_cameras: The V orthographic cameras.
        atlas: [3,A,A] filled texture, float32 in [0,1], row 0 at v = 1.
        atlas_coverage: [A,A] observed share of each texel, [0,1].
    """

    body: BodyModel
    betas: Tensor
    pose: Tensor
    transl: Tensor
    frames: Tensor
    masks: Tensor
    silhouettes: Tensor
    viewmat: Tensor
    K: Tensor
    used: Tensor
    confidence: Tensor
    views: Tensor
    view_coverage: Tensor
    view_cameras: Cameras
    atlas: Tensor
    atlas_coverage: Tensor

    def __post_init__(self) -> None:
        count = len(self.frames)
        for name in ("pose", "transl", "masks", "silhouettes", "used", "confidence"):
            if len(getattr(self, name)) != count:
                raise ValueError(f"expected {count} rows of {name} (one a frame), got {len(getattr(self, name))}")
        if self.frames.ndim != 4 or self.frames.shape[1] != 3 or self.masks.shape[1:] != self.frames.shape[2:]:
            raise ValueError(
                "expected frames [T,3,H,W] and masks [T,H,W] of one size, got "
                f"{tuple(self.frames.shape)} and {tuple(self.masks.shape)}; channel-first in the core"
            )
        if self.silhouettes.shape != self.masks.shape:
            raise ValueError(
                f"expected silhouettes as the masks, {tuple(self.masks.shape)}, got {tuple(self.silhouettes.shape)}"
            )
        cameras = self.view_cameras
        size = (len(cameras), 4, cameras.height, cameras.width)
        if tuple(self.views.shape) != size or self.view_coverage.shape != self.views[:, 0].shape:
            raise ValueError(
                f"expected canonical views {size} with a coverage each, got {tuple(self.views.shape)} "
                f"and {tuple(self.view_coverage.shape)}; use the cameras that made them"
            )


@dataclass(frozen=True)
class Frame:
    """One observed frame, cut to the box of its mask.

    Attributes:
        number: Index into the ingested frames.
        target: [3,h,w] sRGB in [0,1].
        weight: [1,h,w] alpha of the visible person times the frame's confidence.
        empty: [1,h,w] confidence where there is surely nobody: away from both the visible person and the fitted body.
        camera: The observed camera, cut to the box.
        relative: [J,4,4] canonical -> posed, joint by joint.
    """

    number: int
    target: Tensor
    weight: Tensor
    empty: Tensor
    camera: Cameras
    relative: Tensor


def unit_range(image: Tensor) -> Tensor:
    """uint8 or float images as float32 in [0,1]."""
    return image.float() / 255 if image.dtype == torch.uint8 else image.float()


def observed_frames(inputs: CoarseInputs, limit: int) -> tuple[list[Frame], list[str]]:
    """Usable frames, at most `limit` of them evenly spread, and a note on every one that was left out.

    Left out are frames without a fitted person, with an empty mask, or with a NaN or an infinity in picture, mask,
    pose or confidence.
    """
    good: list[int] = []
    reasons: dict[str, list[int]] = {}
    for number in range(len(inputs.frames)):
        reason = _fault(inputs, number)
        if reason is None:
            good.append(number)
        else:
            reasons.setdefault(reason, []).append(number)
    notes = [f"frames {_ranges(numbers)} not used: {reason}" for reason, numbers in reasons.items()]
    if len(good) > limit:
        good = [good[round(i * (len(good) - 1) / max(1, limit - 1))] for i in range(limit)]
    if not good:
        return [], [*notes, "no observed frame is usable: trained on the canonical views alone"]
    with torch.no_grad():
        relative = relative_transforms(inputs.body, inputs.pose[good], inputs.betas, inputs.transl[good])
    return [_cut(inputs, number, rows) for number, rows in zip(good, relative, strict=True)], notes


def _fault(inputs: CoarseInputs, number: int) -> str | None:
    if not bool(inputs.used[number]):
        return "no person was fitted"
    numbers = (inputs.pose[number], inputs.transl[number], inputs.confidence[number])
    if not all(bool(torch.isfinite(value).all()) for value in numbers):
        return "pose, place or confidence is not finite"
    if not all(bool(torch.isfinite(unit_range(v)).all()) for v in (inputs.frames[number], inputs.masks[number])):
        return "picture or mask is not finite"
    if float(unit_range(inputs.masks[number]).sum()) < MIN_MASK_AREA:
        return "the mask is empty"
    return "its confidence is 0" if float(inputs.confidence[number]) <= 0 else None


def _ranges(numbers: Sequence[int]) -> str:
    """3, 4, 5, 9 -> "3-5, 9"."""
    parts: list[list[int]] = []
    for number in numbers:
        if parts and number == parts[-1][1] + 1:
            parts[-1][1] = number
        else:
            parts.append([number, number])
    return ", ".join(str(a) if a == b else f"{a}-{b}" for a, b in parts)


def _cut(inputs: CoarseInputs, number: int, relative: Tensor) -> Frame:
    mask = unit_range(inputs.masks[number]).clamp(0, 1)
    x0, y0, x1, y1 = mask_box(mask, _MARGIN + round(_MARGIN_SHARE * mask.shape[0]))
    near = (mask > _TRACE) | (unit_range(inputs.silhouettes[number]) > _TRACE)
    around = max_pool2d(near[None].float(), 2 * _UNSURE + 1, stride=1, padding=_UNSURE)
    K = inputs.K.float().clone()
    K[0, 2] -= x0
    K[1, 2] -= y0
    return Frame(
        number=number,
        target=unit_range(inputs.frames[number])[:, y0:y1, x0:x1],
        weight=mask[None, y0:y1, x0:x1] * float(inputs.confidence[number]),
        empty=(1 - around[:, y0:y1, x0:x1]) * float(inputs.confidence[number]),
        camera=Cameras(inputs.viewmat.float()[None], K[None], x1 - x0, y1 - y0, "pinhole"),
        relative=relative,
    )


@dataclass(frozen=True)
class CanonicalViews:
    """The V canonical images: target [V,3,H,W] over grey, alpha [V,1,H,W], weight [V,1,H,W], cameras."""

    target: Tensor
    alpha: Tensor
    weight: Tensor
    cameras: Cameras


def canonical_views(inputs: CoarseInputs, weights: LossWeights) -> tuple[CanonicalViews, list[str]]:
    """The canonical images over grey, weighted by coverage; a view with a NaN gets weight 0 and a note.

    Args:
        inputs: The inputs.
        weights: Weights of seen, filled and outside pixels (see `losses.canonical_weight`).
    """
    views, coverage = inputs.views.float(), inputs.view_coverage.float()
    fine = torch.isfinite(views).flatten(1).all(1) & torch.isfinite(coverage).flatten(1).all(1)
    rgb, alpha = torch.nan_to_num(views[:, :3]), torch.nan_to_num(views[:, 3:]).clamp(0, 1)
    seen = torch.nan_to_num(coverage)[:, None].clamp(0, 1)
    weight = canonical_weight(seen, alpha, weights) * fine[:, None, None, None]
    notes = [f"canonical view {number} not used: not finite" for number in torch.nonzero(~fine)[:, 0].tolist()]
    return CanonicalViews(rgb * alpha + GREY * (1 - alpha), alpha, weight, inputs.view_cameras), notes
