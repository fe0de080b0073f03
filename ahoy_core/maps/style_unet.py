"""StyleUNet: canonical maps in, one map of Gaussian property offsets per side out (paper section 3.1).

Written from the papers (StyleAvatar's StyleUNet, and its use with a front and a back decoder in Animatable
Gaussians): an encoder of strided convolutions on the Haar bands of the input, one decoder per side of style-modulated
convolutions with skips from the encoder, and at every resolution a head that adds to the output in the Haar domain.
All heads start at zero, so an untrained network predicts no offset at all.
"""

from __future__ import annotations

import math
from itertools import pairwise

import torch
from pydantic import BaseModel, ConfigDict, Field, model_validator
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812

from ahoy_core.maps.wavelet import haar, inverse_haar

# A leaky ReLU of slope 0.2 halves the variance of a unit normal; this gain brings it back (StyleGAN2).
_LEAK, _GAIN = 0.2, math.sqrt(2.0)


class StyleUNetConfig(BaseModel):
    """Size of a StyleUNet: the two knobs that trade accuracy for time are `map_size` and `width`."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    map_size: int = Field(default=256, ge=16, description="side of the input and output maps, pixels; a power of two")
    width: int = Field(default=16, ge=4, description="channels at the finest resolution; doubled at each coarser one")
    max_channels: int = Field(default=64, ge=4, description="upper bound of the channels at coarse resolutions")
    bottleneck: int = Field(default=8, ge=2, description="side of the coarsest feature map; a power of two")
    in_channels: int = Field(default=14, ge=1, description="channels of the input maps, both sides together")
    out_channels: int = Field(default=19, ge=1, description="offsets per map pixel")
    sides: int = Field(default=2, ge=1, description="decoders: front and back")
    style_size: int = Field(default=32, ge=1, description="length of the style vector")

    @model_validator(mode="after")
    def _powers_of_two(self) -> StyleUNetConfig:
        for name in ("map_size", "bottleneck"):
            value = getattr(self, name)
            if value & (value - 1):
                raise ValueError(f"expected {name} to be a power of two, got {value}")
        if self.bottleneck * 4 > self.map_size:
            raise ValueError(f"expected bottleneck <= map_size / 4, got {self.bottleneck} for maps of {self.map_size}")
        return self

    def channels(self) -> list[int]:
        """Channels at each resolution, finest (map_size / 2) first, bottleneck last."""
        levels = int(math.log2(self.map_size // 2 // self.bottleneck)) + 1
        return [min(self.width * 2**level, self.max_channels) for level in range(levels)]


def _normal(shape: tuple[int, ...], generator: torch.Generator) -> nn.Parameter:
    return nn.Parameter(torch.randn(shape, generator=generator))


class _Linear(nn.Module):
    """Fully connected layer with equalised learning rate: unit-normal weights, scaled when used (StyleGAN2)."""

    def __init__(self, n_in: int, n_out: int, generator: torch.Generator, bias: float = 0.0) -> None:
        super().__init__()
        self.weight = _normal((n_out, n_in), generator)
        self.bias = nn.Parameter(torch.full((n_out,), bias))

    def forward(self, x: Tensor) -> Tensor:
        return F.linear(x, self.weight / math.sqrt(self.weight.shape[1]), self.bias)


class _Conv(nn.Module):
    """3x3 convolution with equalised learning rate and leaky ReLU."""

    def __init__(self, n_in: int, n_out: int, generator: torch.Generator, stride: int = 1) -> None:
        super().__init__()
        self.weight, self.bias = _normal((n_out, n_in, 3, 3), generator), nn.Parameter(torch.zeros(n_out))
        self.stride, self.scale = stride, 1.0 / math.sqrt(9 * n_in)

    def forward(self, x: Tensor) -> Tensor:
        y = F.conv2d(x, self.weight * self.scale, self.bias, stride=self.stride, padding=1)
        return F.leaky_relu(y, _LEAK) * _GAIN


class _StyledConv(nn.Module):
    """3x3 convolution whose input channels are scaled by the style and whose output is brought back to unit variance.

    Scaling activations instead of weights keeps one convolution for the whole batch; the result is the same
    (StyleGAN2, section 3).
    """

    def __init__(self, n_in: int, n_out: int, style_size: int, generator: torch.Generator) -> None:
        super().__init__()
        self.weight, self.bias = _normal((n_out, n_in, 3, 3), generator), nn.Parameter(torch.zeros(n_out))
        self.style = _Linear(style_size, n_in, generator, bias=1.0)
        self.scale = 1.0 / math.sqrt(9 * n_in)

    def forward(self, x: Tensor, style: Tensor) -> Tensor:
        weight, scales = self.weight * self.scale, self.style(style)
        power = torch.einsum("oi,bi->bo", weight.square().sum((2, 3)), scales.square())
        y = F.conv2d(x * scales[:, :, None, None], weight, padding=1) * torch.rsqrt(power + 1e-8)[:, :, None, None]
        return F.leaky_relu(y + self.bias[:, None, None], _LEAK) * _GAIN


class _Head(nn.Module):
    """Styled 1x1 convolution to the four Haar bands of the offsets; starts at zero."""

    def __init__(self, n_in: int, n_out: int, style_size: int, generator: torch.Generator) -> None:
        super().__init__()
        self.weight, self.bias = nn.Parameter(torch.zeros(4 * n_out, n_in, 1, 1)), nn.Parameter(torch.zeros(4 * n_out))
        self.style = _Linear(style_size, n_in, generator, bias=1.0)
        self.scale = 1.0 / math.sqrt(n_in)

    def forward(self, x: Tensor, style: Tensor) -> Tensor:
        scales = self.style(style)
        return inverse_haar(F.conv2d(x * scales[:, :, None, None], self.weight * self.scale, self.bias))


class _Decoder(nn.Module):
    """From the bottleneck back to the maps' resolution, with skips; sums the heads of all resolutions."""

    def __init__(self, config: StyleUNetConfig, generator: torch.Generator) -> None:
        super().__init__()
        widths, size = config.channels(), config.style_size
        joins, refines, heads = [], [], []
        n_in = widths[-1]
        for n_out in reversed(widths):
            joins.append(_StyledConv(n_in + n_out, n_out, size, generator))
            refines.append(_StyledConv(n_out, n_out, size, generator))
            heads.append(_Head(n_out, config.out_channels, size, generator))
            n_in = n_out
        self.joins, self.refines, self.heads = nn.ModuleList(joins), nn.ModuleList(refines), nn.ModuleList(heads)

    def forward(self, x: Tensor, skips: list[Tensor], style: Tensor) -> Tensor:
        out: Tensor | None = None
        for skip, join, refine, head in zip(reversed(skips), self.joins, self.refines, self.heads, strict=True):
            if out is not None:
                x = F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)
                out = F.interpolate(out, scale_factor=2, mode="bilinear", align_corners=False)
            x = refine(join(torch.cat([x, skip], 1), style), style)
            out = head(x, style) if out is None else out + head(x, style)
        assert out is not None
        return out


class StyleUNet(nn.Module):
    """S of paper section 3.1: per-pixel offsets of every Gaussian property, one map per side.

    Args:
        config: Sizes.
        generator: Source of the initial weights: two networks made with equally seeded generators are equal.
    """

    def __init__(self, config: StyleUNetConfig, generator: torch.Generator) -> None:
        super().__init__()
        self.config = config
        widths = config.channels()
        self.stem = _Conv(4 * config.in_channels, widths[0], generator)
        self.downs = nn.ModuleList(_Conv(n_in, n_out, generator, stride=2) for n_in, n_out in pairwise(widths))
        self.bottom = _Conv(widths[-1], widths[-1], generator)
        self.latent = _normal((1, config.style_size), generator)
        self.mapping = nn.ModuleList(_Linear(config.style_size, config.style_size, generator) for _ in range(2))
        self.decoders = nn.ModuleList(_Decoder(config, generator) for _ in range(config.sides))

    def forward(self, maps: Tensor) -> Tensor:
        """Predict the offsets.

        Args:
            maps: [B,in_channels,S,S] canonical maps of both sides, stacked along the channels.

        Returns:
            [B,sides,out_channels,S,S], exactly zero for an untrained network.

        Raises:
            ValueError: If the maps do not have the configured shape.
        """
        expected = (self.config.in_channels, self.config.map_size, self.config.map_size)
        if tuple(maps.shape[1:]) != expected:
            raise ValueError(
                f"expected maps of shape [B,{expected}], got {tuple(maps.shape)}; rebuild them at this size"
            )
        style = self.latent.expand(maps.shape[0], -1)
        for layer in self.mapping:
            style = F.leaky_relu(layer(style), _LEAK) * _GAIN
        skips = [self.stem(haar(maps))]
        for down in self.downs:
            skips.append(down(skips[-1]))
        x = self.bottom(skips[-1])
        return torch.stack([decoder(x, skips, style) for decoder in self.decoders], 1)
