"""From the six phenotype parameters to weights of the body's corner shapes (Anny's rule: piecewise multilinear)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

BETA_NAMES = ("gender", "age", "muscle", "weight", "height", "proportions")
# Evenly spaced anchors on [0,1]: male/female; baby, child, young, old; and low (average) high for the rest.
ANCHOR_COUNTS = (2, 4, 3, 3, 2, 2)


def interpolation_weights(values: Tensor, count: int) -> Tensor:
    """Weights [B,count] of evenly spaced anchors on [0,1] for linear interpolation at `values` [B].

    Values are clamped to [0,1]. At an anchor the gradient is the one of the segment below it (above it at 0), never
    zero.
    """
    scaled = values.clamp(0, 1) * (count - 1)
    lower = (scaled.detach().ceil() - 1).clamp(0, count - 2)
    alpha = (scaled - lower)[:, None]
    index = lower.long()[:, None]
    anchors = torch.arange(count, device=values.device)
    return (anchors == index) * (1 - alpha) + (anchors == index + 1) * alpha


def corner_weights(betas: Tensor, counts: Sequence[int] = ANCHOR_COUNTS) -> Tensor:
    """Weights [B, prod(counts)] of the corner shapes, rows sum to 1; the last parameter varies fastest.

    Args:
        betas: [B,S], each in [0,1] (values outside are clamped and have no gradient).
        counts: number of anchors of each parameter.
    """
    weights = torch.ones_like(betas[:, :1])
    for column, count in enumerate(counts):
        along = interpolation_weights(betas[:, column], count)
        weights = (weights[:, :, None] * along[:, None]).flatten(1)
    return weights
