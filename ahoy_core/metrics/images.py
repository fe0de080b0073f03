"""PSNR, SSIM and IoU of images in [0,1]."""

from __future__ import annotations

import torch
from kornia.metrics import ssim as kornia_ssim
from torch import Tensor

# A difference below one part in 10^5 is beyond what 8-bit pictures can show; it keeps equal images finite, at 100 dB.
_MIN_MSE = 1e-10
SSIM_WINDOW = 11


def _check(image: Tensor, target: Tensor) -> None:
    if image.shape != target.shape or image.ndim < 3:
        raise ValueError(
            f"expected two images [...,C,H,W] of one shape, got {tuple(image.shape)} and {tuple(target.shape)}"
        )
    if image.numel() == 0:
        raise ValueError("expected images with pixels, got an empty region; leave the frame out")


def psnr(image: Tensor, target: Tensor) -> float:
    """Peak signal-to-noise ratio in dB of images [...,C,H,W] in [0,1], over all their pixels; 100 for equal ones.

    Raises:
        ValueError: If the shapes differ or there are no pixels.
    """
    _check(image, target)
    mse = (image.double() - target.double()).square().mean().clamp(min=_MIN_MSE)
    return float(-10 * torch.log10(mse))


def ssim(image: Tensor, target: Tensor) -> float:
    """Mean structural similarity of images [C,H,W] in [0,1]: kornia's, Gaussian window of 11 pixels, sigma 1.5.

    Raises:
        ValueError: If the shapes differ, or a side is shorter than the window's half.
    """
    return float(ssim_map(image, target).mean())


def ssim_map(image: Tensor, target: Tensor) -> Tensor:
    """Structural similarity [C,H,W] by pixel; at the border the images are continued by reflection.

    Raises:
        ValueError: As `ssim`.
    """
    _check(image, target)
    if min(image.shape[-2:]) <= SSIM_WINDOW // 2:
        raise ValueError(f"expected sides above {SSIM_WINDOW // 2} pixels, got {tuple(image.shape[-2:])}")
    return kornia_ssim(image.float()[None], target.float()[None], SSIM_WINDOW)[0]


def iou(mask: Tensor, target: Tensor, threshold: float = 0.5) -> float:
    """Intersection over union of two masks [...,H,W] in [0,1] cut at `threshold`; 1 where both are empty.

    Raises:
        ValueError: If the shapes differ.
    """
    if mask.shape != target.shape:
        raise ValueError(f"expected masks of one shape, got {tuple(mask.shape)} and {tuple(target.shape)}")
    first, second = mask > threshold, target > threshold
    union = int((first | second).sum())
    return int((first & second).sum()) / union if union else 1.0
