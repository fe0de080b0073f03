"""One picture against its truth: every metric over every region (paper section 4)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from ahoy_core.conventions import GREY
from ahoy_core.metrics.images import SSIM_WINDOW, iou, psnr, ssim_map
from ahoy_core.metrics.perceptual import Perceptual
from ahoy_core.metrics.protocol import Pixels
from ahoy_core.metrics.regions import mask_box
from ahoy_core.metrics.stlpips import MIN_SIDE

REGIONS = ("box", "mask", "full", "observed", "unobserved", "head")
"""box: that of the true mask; mask: its pixels; full: the picture; (un)observed: pixels of the mask that show surface
which the input showed (never showed); head: the box of the head."""

LEAST_PIXELS = 64  # fewer say nothing about a region


@dataclass(frozen=True)
class Truth:
    """What a render is compared with.

    Attributes:
        rgb: [3,H,W] sRGB in [0,1].
        alpha: [H,W] of the person, [0,1].
        known: [H,W] bool; other pixels are not compared.
        observed: [H,W] bool, the pixel shows surface that the input showed; None where that is not known.
        head: Box x0, y0, x1, y1 of the head, half open, or None.
    """

    rgb: Tensor
    alpha: Tensor
    known: Tensor
    observed: Tensor | None = None
    head: tuple[int, int, int, int] | None = None


@dataclass(frozen=True)
class Made:
    """A picture to be scored: rgb [3,H,W] over grey 0.5, and its alpha [H,W] (None where a system gives none)."""

    rgb: Tensor
    alpha: Tensor | None


@dataclass(frozen=True)
class Score:
    """Metrics of one picture in one region; None where a metric says nothing there."""

    region: str
    psnr: float
    ssim: float | None
    perceptual: float | None
    iou: float | None


@torch.no_grad()
def score_picture(made: Made, truth: Truth, pixels: Pixels, perceptual: Perceptual | None = None) -> list[Score]:
    """Score one picture.

    Both pictures are laid over grey 0.5; where the truth is not known both show grey. PSNR is over the known pixels of
    a region, SSIM the mean of its map over them, the perceptual distance that of the boxes of person and head, IoU
    that of the alphas at 0.5.

    Args:
        made: The picture, of the truth's size.
        truth: What it should be.
        pixels: "visible part" cuts both out by the true alpha, so that what is hidden does not count.
        perceptual: The perceptual role, or None.

    Returns:
        A score per region of `REGIONS` that has at least `LEAST_PIXELS` known pixels.

    Raises:
        ValueError: The sizes differ, or the true mask is empty.
    """
    if made.rgb.shape != truth.rgb.shape or truth.alpha.shape != truth.rgb.shape[1:]:
        raise ValueError(
            f"expected a picture {tuple(truth.rgb.shape)} as its truth, got {tuple(made.rgb.shape)}; render at that "
            "size"
        )
    image, target = _composited(made, truth, pixels)
    overlap = None
    if made.alpha is not None and pixels == "whole person":
        overlap = iou(made.alpha * truth.known, truth.alpha * truth.known)
    scores = []
    similar: dict[tuple[int, int, int, int], Tensor | None] = {}
    for region, (box, inside) in regions(truth).items():
        x0, y0, x1, y1 = box
        cut = (slice(y0, y1), slice(x0, x1))
        kept = inside[cut] & truth.known[cut]
        if int(kept.sum()) < LEAST_PIXELS:
            continue
        first, second = image[:, *cut], target[:, *cut]
        if box not in similar:
            similar[box] = _similarity(first, second)
        structure = similar[box]
        scores.append(
            Score(
                region,
                psnr(first[:, kept][..., None], second[:, kept][..., None]),
                None if structure is None else float(structure[:, kept].mean()),
                _distance(perceptual, first, second) if region in ("box", "head") else None,
                overlap if region in ("box", "mask", "full") else None,
            )
        )
    return scores


def regions(truth: Truth) -> dict[str, tuple[tuple[int, int, int, int], Tensor]]:
    """Box and pixels [H,W] of each region that the truth allows.

    Raises:
        ValueError: The true mask is empty.
    """
    height, width = truth.alpha.shape
    box, full = mask_box(truth.alpha), (0, 0, width, height)
    everything, person = torch.ones_like(truth.known), truth.alpha > 0.5
    found = {"box": (box, everything), "mask": (box, person), "full": (full, everything)}
    if truth.observed is not None:
        found |= {"observed": (box, person & truth.observed), "unobserved": (box, person & ~truth.observed)}
    if truth.head is not None:
        found["head"] = (truth.head, everything)
    return found


def _composited(made: Made, truth: Truth, pixels: Pixels) -> tuple[Tensor, Tensor]:
    target = truth.rgb * truth.alpha + GREY * (1 - truth.alpha)
    image = made.rgb.clamp(0, 1)
    if pixels == "visible part":
        image = image * truth.alpha + GREY * (1 - truth.alpha)
    grey = torch.full_like(target, GREY)
    return torch.where(truth.known, image, grey), torch.where(truth.known, target, grey)


def _similarity(image: Tensor, target: Tensor) -> Tensor | None:
    if min(image.shape[-2:]) <= SSIM_WINDOW // 2:
        return None
    return ssim_map(image, target)


def _distance(perceptual: Perceptual | None, image: Tensor, target: Tensor) -> float | None:
    if perceptual is None or min(image.shape[-2:]) < MIN_SIDE:
        return None
    value = float(perceptual(image[None].float(), target[None].float())[0])
    return value if math.isfinite(value) else None


def shifted(truth: Truth, pixels: int = 2) -> Made:
    """Reference row: the truth itself, moved to the right by some pixels (what a small error of pose costs)."""
    alpha = torch.roll(truth.alpha, pixels, 1)
    alpha[:, :pixels] = 0
    rgb = torch.roll(truth.rgb, pixels, 2)
    return Made(rgb * alpha + GREY * (1 - alpha), alpha)


def flat(truth: Truth) -> Made:
    """Reference row: one colour, the person's mean, in the true silhouette (what a score without appearance is)."""
    weight = truth.alpha * truth.known
    mean = (truth.rgb * weight).sum((1, 2)) / weight.sum().clamp(min=1e-6)
    return Made(mean[:, None, None] * truth.alpha + GREY * (1 - truth.alpha), truth.alpha)


REFERENCES: Mapping[str, str] = {
    "reference: shifted 2 px": "the true picture, 2 pixels to the right",
    "reference: flat colour": "the person's mean colour in the true silhouette",
}
