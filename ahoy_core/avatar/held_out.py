"""What both trainings say of the observed frame that they never saw, and of how far they are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

Progress = Callable[[int, int, float], None]
"""Called with (step, steps, loss) after every step."""


@dataclass(frozen=True)
class HeldOut:
    """Score of the frame that training never saw, under `protocol`; before is what the training started from."""

    frame: int
    protocol: str
    psnr_before: float
    psnr_after: float
    ssim_before: float
    ssim_after: float
