"""What the full avatar's training moves: offsets that all poses share, and a StyleUNet for what depends on the pose.

The paper re-initialises a StyleUNet on pose-dependent maps. Here it is added to offsets per Gaussian that start at
the coarse avatar's: what poses have in common, texture above all, is then learned in few steps and at the template's
full resolution, and the network (its heads at zero) has only the difference between poses to explain.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from ahoy_core.avatar.deform import Canonical, OffsetBounds, apply_offsets, offset_channels
from ahoy_core.avatar.pose_maps import PoseMaps
from ahoy_core.maps.style_unet import StyleUNet, StyleUNetConfig


class FullModel(nn.Module):
    """Canonical Gaussians for map poses.

    Args:
        maps: Maker of pose maps.
        width: Channels of the StyleUNet at its finest resolution.
        bounds: Largest offsets.
        base: [N,C] raw offsets to start from; zero (the textured body) by default.
        generator: Source of the network's first weights.
    """

    def __init__(
        self, maps: PoseMaps, width: int, bounds: OffsetBounds, base: Tensor | None, generator: torch.Generator
    ) -> None:
        super().__init__()
        channels = offset_channels(maps.template)
        start = torch.zeros(len(maps.template), channels) if base is None else base
        if tuple(start.shape) != (len(maps.template), channels):
            raise ValueError(
                f"expected base offsets {(len(maps.template), channels)}, got {tuple(start.shape)}; "
                "they must come from the same template"
            )
        self.maps, self.bounds = maps, bounds
        self.base = nn.Parameter(start.detach().clone())
        self.network = StyleUNet(full_network_config(maps, width), generator)

    def raw(self, inputs: Tensor) -> tuple[list[Tensor], Tensor]:
        """Raw offsets [N,C] for each of G maps [G,14,s,s], and the mean square of their pose-dependent part."""
        dependent = [self.maps.gather(out) for out in self.network(inputs)]
        change = torch.stack([part.square().mean() for part in dependent]).mean()
        return [self.base + part for part in dependent], change

    def forward(self, inputs: Tensor) -> tuple[Sequence[Canonical], Tensor]:
        """Canonical Gaussians of each of G maps, and the mean square of the pose-dependent part."""
        raws, change = self.raw(inputs)
        return [apply_offsets(self.maps.template, raw, self.bounds) for raw in raws], change


def full_network_config(maps: PoseMaps, width: int) -> StyleUNetConfig:
    """The StyleUNet's sizes for pose maps."""
    return StyleUNetConfig(
        map_size=maps.size,
        width=width,
        bottleneck=min(8, maps.size // 4),
        in_channels=14,
        out_channels=offset_channels(maps.template),
    )
