"""The perceptual role: a distance of pictures that a person would agree with, by whoever fills it."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor

from ahoy_core.metrics.stlpips import MIN_SIDE


class Perceptual(Protocol):
    """A distance of pictures, with a name."""

    @property
    def name(self) -> str:
        """What it is called wherever its numbers stand."""
        ...

    def __call__(self, a: Tensor, b: Tensor) -> Tensor:
        """Distance [B] of pictures [B,3,H,W] in [0,1], sides of 32 pixels or more."""
        ...


def patch_distance(
    perceptual: Perceptual, image: Tensor, target: Tensor, weight: Tensor, side: int, generator: torch.Generator
) -> Tensor:
    """Distance of one random patch of two pictures; a scalar, 0 where the pictures are too small for one.

    Args:
        perceptual: The role.
        image: [3,H,W].
        target: [3,H,W].
        weight: [1,H,W]; where it is 0 both show the target, which masks without an edge of its own.
        side: Of the patch, pixels; at most the picture's.
        generator: Places the patch.
    """
    height, width = target.shape[1:]
    tall, wide = min(side, height), min(side, width)
    if min(tall, wide) < MIN_SIDE:
        return image.new_zeros(())
    top = int(torch.randint(height - tall + 1, (1,), generator=generator))
    left = int(torch.randint(width - wide + 1, (1,), generator=generator))
    cut = (slice(None), slice(top, top + tall), slice(left, left + wide))
    share = weight[cut].clamp(0, 1)
    masked = image[cut] * share + target[cut] * (1 - share)
    return perceptual(masked[None], target[cut][None])[0]
