"""Gaussians through cameras to images in the core's layout, over one grey."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ahoy_core.conventions import GREY, Cameras
from ahoy_core.splat import rasterization


class Rendered(NamedTuple):
    """images [C,3,H,W] sRGB over the background, alphas [C,1,H,W] in [0,1]."""

    images: Tensor
    alphas: Tensor


def render(
    means: Tensor, covars: Tensor, opacities: Tensor, colors: Tensor, cameras: Cameras, background: float = GREY
) -> Rendered:
    """Rasterize (R of paper section 3.1).

    Args:
        means: [N,3] world, metres.
        covars: [N,3,3] metres².
        opacities: [N] in [0,1].
        colors: [N,3] sRGB.
        cameras: C cameras.
        background: Grey level behind everything.
    """
    # The rasterizer reads covars alone; quats and scales are there for their shapes.
    quats = means.new_tensor([1.0, 0.0, 0.0, 0.0]).expand(len(means), 4).contiguous()
    image, alpha, _ = rasterization(
        means,
        quats,
        torch.ones_like(means),
        opacities,
        colors,
        cameras.viewmats.to(means),
        cameras.Ks.to(means),
        cameras.width,
        cameras.height,
        backgrounds=means.new_full((len(cameras), colors.shape[-1]), background),
        camera_model=cameras.camera_model,
        covars=covars,
    )
    return Rendered(image.permute(0, 3, 1, 2), alpha.permute(0, 3, 1, 2))
