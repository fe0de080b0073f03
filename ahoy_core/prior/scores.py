"""How near generated pictures are to the truth inside a region: error, sharpness, colour, perception."""

from __future__ import annotations

import math
from typing import Final

import torch
from torch import Tensor

from ahoy_core.metrics.perceptual import Perceptual

_LEAST: Final = 20.0  # pixels: a region of fewer says nothing about a picture
NO_PERCEPTUAL: Final = "not measured: the weights of ST-LPIPS were not pulled (`ahoy models pull`)"


def psnr(made: Tensor, truth: Tensor, weight: Tensor) -> Tensor:
    """PSNR in dB (peak 1) of pictures [...,3,H,W] under weights [...,1,H,W], one a picture; NaN where none counts."""
    area = weight.sum((-1, -2, -3))
    error = ((made - truth).square() * weight).sum((-1, -2, -3)) / (3 * area)
    return torch.where(area >= _LEAST, -10 * torch.log10(error.clamp(min=1e-10)), torch.full_like(area, math.nan))


def gradient_energy(pictures: Tensor, weight: Tensor) -> float:
    """Mean squared difference of neighbouring pixels inside weights: how sharp pictures are."""
    across = (pictures.diff(dim=-1).square() * weight[..., 1:] * weight[..., :-1]).sum()
    down = (pictures.diff(dim=-2).square() * weight[..., 1:, :] * weight[..., :-1, :]).sum()
    return float((across + down) / (6 * weight.sum()).clamp(min=1))


def colour_distance(made: Tensor, truth: Tensor, weight: Tensor, light_apart: bool = False) -> Tensor:
    """Distance (0 to sqrt 3) of the mean colours of one garment of one subject, over all the frames that show it.

    Args:
        made: [...,T,3,H,W] in [0,1].
        truth: likewise.
        weight: [...,T,1,H,W], the garment's alpha.
        light_apart: bring both to the truth's brightness first. How bright a garment is from a side is the light's
            doing, and the frames of a video do not tell it of the sides that they do not show.

    Returns:
        [...], NaN where the frames show less than `_LEAST` pixels of it.
    """
    area = weight.sum((-4, -3, -2, -1))
    ours, theirs = (_mean_colour(pictures, weight) for pictures in (made, truth))
    if light_apart:
        ours = ours * (theirs.norm(dim=-1) / ours.norm(dim=-1).clamp(min=1e-6))[..., None]
    return torch.where(area >= _LEAST, (ours - theirs).norm(dim=-1), torch.full_like(area, math.nan))


def _mean_colour(pictures: Tensor, weight: Tensor) -> Tensor:
    """[...,3] of pictures [...,T,3,H,W] under weights [...,T,1,H,W]."""
    return (pictures * weight).sum((-4, -2, -1)) / weight.sum((-4, -3, -2, -1)).clamp(min=1e-6)[..., None]


def perceptual_distance(network: Perceptual, made: Tensor, truth: Tensor, weight: Tensor) -> Tensor:
    """Perceptual distance [N] of pictures [N,3,H,W] that differ inside weights [N,1,H,W] alone; NaN where none counts.

    Outside both show the truth, which masks without an edge of its own.
    """
    share = weight.clamp(0, 1)
    distance = network(made * share + truth * (1 - share), truth)
    return torch.where(weight.sum((1, 2, 3)) >= _LEAST, distance, torch.full_like(distance, math.nan))
