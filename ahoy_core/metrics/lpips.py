"""LPIPS v0.1 (Zhang et al., CVPR 2018) on AlexNet or VGG16, from the user's own files of backbone and linear heads.

Written from the paper: differences of normalised features, weighted by channel and averaged over the picture, summed
over five layers. The layers are those whose activations the published heads were trained on.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Final, cast

import torch
from torch import Tensor, nn
from torch.nn.functional import max_pool2d, relu

from ahoy_core.metrics.stlpips import MIN_SIDE, SCALE, SHIFT, check_pictures, weighted_difference
from ahoy_core.models.adapter import OWN_WEIGHTS, Adapter, Fill
from ahoy_core.models.checkpoint import loading_device, read_state, take


@dataclass(frozen=True)
class Conv:
    """A convolution of a backbone: its name in torchvision's file, channels, kernel, stride, padding."""

    name: str
    before: int
    after: int
    kernel: int = 3
    stride: int = 1
    padding: int = 1


@dataclass(frozen=True)
class Backbone:
    """Five stages of convolutions; a max pool of this size and stride 2 lies before the stages in `pooled`."""

    title: str
    stages: tuple[tuple[Conv, ...], ...]
    pool: int
    pooled: tuple[int, ...]


def _vgg_stages() -> tuple[tuple[Conv, ...], ...]:
    layers = iter((0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28))
    stages, channels = [], 3
    for width, depth in ((64, 2), (128, 2), (256, 3), (512, 3), (512, 3)):
        widths = pairwise((channels, *[width] * depth))
        stages.append(tuple(Conv(f"features.{next(layers)}", before, after) for before, after in widths))
        channels = width
    return tuple(stages)


ALEX: Final = Backbone(
    "LPIPS v0.1 (AlexNet)",
    (
        (Conv("features.0", 3, 64, 11, 4, 2),),
        (Conv("features.3", 64, 192, 5, 1, 2),),
        (Conv("features.6", 192, 384),),
        (Conv("features.8", 384, 256),),
        (Conv("features.10", 256, 256),),
    ),
    pool=3,
    pooled=(1, 2),
)
VGG: Final = Backbone("LPIPS v0.1 (VGG16)", _vgg_stages(), pool=2, pooled=(1, 2, 3, 4))


class Lpips(nn.Module):
    """Distance of pictures. Its weights are fixed; gradients run to the pictures.

    Args:
        backbone: `ALEX` or `VGG`.
        own_weights: they are not the published ones; the name says so.
    """

    def __init__(self, backbone: Backbone, own_weights: bool = False) -> None:
        super().__init__()
        self.backbone, self.own_weights = backbone, own_weights
        self.stages = nn.ModuleList(
            nn.ModuleList(nn.Conv2d(c.before, c.after, c.kernel, c.stride, c.padding) for c in stage)
            for stage in backbone.stages
        )
        widths = [stage[-1].after for stage in backbone.stages]
        self.heads = nn.ParameterList(torch.ones(1, width, 1, 1) / width for width in widths)
        self.requires_grad_(False)

    @property
    def name(self) -> str:
        """What its numbers are called."""
        return self.backbone.title + (OWN_WEIGHTS if self.own_weights else "")

    def forward(self, a: Tensor, b: Tensor) -> Tensor:
        """Distance of pictures a and b: [B], at least 0, 0 for equal ones.

        Args:
            a: [B,3,H,W] sRGB in [0,1], sides of at least 32 pixels.
            b: Likewise.

        Raises:
            ValueError: If the shapes differ or a side is too short.
        """
        check_pictures(a, b, MIN_SIDE)
        return weighted_difference(self.features(a), self.features(b), self.heads)

    def features(self, image: Tensor) -> list[Tensor]:
        """Activations after each stage for [B,3,H,W] in [0,1]."""
        shift, scale = (image.new_tensor(values)[:, None, None] for values in (SHIFT, SCALE))
        x = (2 * image - 1 - shift) / scale
        out = []
        for number, stage in enumerate(self.stages):
            if number in self.backbone.pooled:
                x = max_pool2d(x, self.backbone.pool, stride=2)
            for conv in cast(nn.ModuleList, stage):
                x = relu(conv(x))
            out.append(x)
        return out


def load_alex(fill: Fill, adapter: Adapter) -> Lpips:
    """`alexnet-owt-7be5be79.pth` and `alex.pth` of a folder; see `load_lpips`."""
    return load_lpips(fill, adapter, ALEX)


def load_vgg(fill: Fill, adapter: Adapter) -> Lpips:
    """`vgg16-397923af.pth` and `vgg.pth` of a folder; see `load_lpips`."""
    return load_lpips(fill, adapter, VGG)


def load_lpips(fill: Fill, adapter: Adapter, backbone: Backbone) -> Lpips:
    """Read backbone and heads.

    Args:
        fill: `path` is the folder with both files of `adapter.files`.
        adapter: its declaration.
        backbone: which one.

    Raises:
        CheckpointError: a file is truncated or another network's; missing keys are named.
    """
    assert fill.path is not None
    network = Lpips(backbone, fill.own_weights)
    body, heads = (fill.path / file.name for file in adapter.files)
    convs = {f"{c.name}.{part}": getattr(conv, part) for c, conv in _convs(network) for part in ("weight", "bias")}
    _fill(convs, body, adapter)
    _fill({f"lin{n}.model.1.weight": head for n, head in enumerate(network.heads)}, heads, adapter)
    return network.to(loading_device(fill)).eval()


def _convs(network: Lpips) -> list[tuple[Conv, nn.Module]]:
    pairs = zip(network.backbone.stages, network.stages, strict=True)
    return [pair for said, built in pairs for pair in zip(said, cast(nn.ModuleList, built), strict=True)]


def _fill(wanted: Mapping[str, Tensor], path: Path, adapter: Adapter) -> None:
    found = take(read_state(path, adapter), wanted, path, adapter)
    with torch.no_grad():
        for name, tensor in wanted.items():
            tensor.copy_(found[name])
