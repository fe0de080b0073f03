"""sRGB and linear light (IEC 61966-2-1): light is added and scaled in linear."""

from __future__ import annotations

import torch
from torch import Tensor


def to_linear(srgb: Tensor) -> Tensor:
    """SRGB values of any shape -> linear; below 0 is taken as 0."""
    srgb = srgb.clamp(min=0)
    return torch.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055).clamp(min=1e-8) ** 2.4)


def to_srgb(linear: Tensor) -> Tensor:
    """Linear values of any shape -> sRGB; below 0 is taken as 0."""
    linear = linear.clamp(min=0)
    return torch.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear.clamp(min=1e-8) ** (1 / 2.4) - 0.055)
