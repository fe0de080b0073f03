"""Codes frames one by one, 8x down, 16 channels: trains and runs on a CPU, in diffusers' on-disk format."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from ahoy_core.prior.conditioning import FACTOR

try:
    from diffusers.configuration_utils import ConfigMixin, register_to_config
    from diffusers.models.modeling_utils import ModelMixin
except ImportError as error:
    raise ImportError("expected the package diffusers, got none; run pip install 'ahoy-avatars[prior]'") from error


class _Residual(nn.Module):
    """x + conv(silu(conv(silu(norm(x)))))."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = nn.GroupNorm(8, width)
        self.first = nn.Conv2d(width, width, 3, padding=1)
        self.second = nn.Conv2d(width, width, 3, padding=1)
        nn.init.zeros_(self.second.weight)

    def forward(self, x: Tensor) -> Tensor:
        act = nn.functional.silu
        return x + self.second(act(self.first(act(self.norm(x)))))


class FrameAutoencoder(ModelMixin, ConfigMixin):
    """A plain autoencoder of single frames.

    Beside the convolutions a linear path runs from 8x8 pixels to a latent and back: it is as good as a principal
    component analysis from the first minutes on, and leaves to the convolutions what is left.

    Args:
        latent_channels: of the latents.
        widths: channels at 1/2, 1/4 and 1/8 of the size.
        latents_mean: per channel, over the corpus; `normalized` latents have mean 0.
        latents_std: per channel; `normalized` latents have standard deviation 1.
        cell_readout: [12][C+1], the linear map from a normalized latent to the mean colours of its four cells.
    """

    @register_to_config
    def __init__(
        self,
        latent_channels: int = 16,
        widths: Sequence[int] = (32, 64, 128),
        latents_mean: Sequence[float] | None = None,
        latents_std: Sequence[float] | None = None,
        cell_readout: Sequence[Sequence[float]] | None = None,
    ) -> None:
        super().__init__()
        half, quarter, eighth = widths
        self.encoder_skip = nn.Sequential(nn.PixelUnshuffle(8), nn.Conv2d(192, latent_channels, 1))
        self.encoder = nn.Sequential(
            nn.PixelUnshuffle(4),
            nn.Conv2d(48, quarter, 3, padding=1),
            _Residual(quarter),
            nn.Conv2d(quarter, eighth, 3, stride=2, padding=1),
            _Residual(eighth),
            _Residual(eighth),
            nn.Conv2d(eighth, latent_channels, 1),
        )
        self.decoder_skip = nn.Sequential(nn.Conv2d(latent_channels, 192, 1), nn.PixelShuffle(8))
        self.decoder = nn.Sequential(
            nn.Conv2d(latent_channels, eighth, 3, padding=1),
            _Residual(eighth),
            _Residual(eighth),
            nn.Conv2d(eighth, quarter * 4, 1),
            nn.PixelShuffle(2),
            _Residual(quarter),
            nn.Conv2d(quarter, half * 4, 1),
            nn.PixelShuffle(2),
            _Residual(half),
            nn.SiLU(),
            nn.Conv2d(half, 12, 3, padding=1),
            nn.PixelShuffle(2),
        )
        last: Any
        for last in (self.encoder[-1], self.decoder[-2]):
            nn.init.zeros_(last.weight)
        skip: Any = self.encoder_skip[1]
        nn.init.orthogonal_(skip.weight.flatten(1))

    def encode(self, frames: Tensor) -> Tensor:
        """Frames [N,3,H,W] in [-1,1] -> latents [N,C,H/8,W/8], not normalized.

        Raises:
            ValueError: when a side is not divisible by 8.
        """
        if frames.shape[-1] % FACTOR or frames.shape[-2] % FACTOR:
            raise ValueError(f"expected sides divisible by {FACTOR}, got {tuple(frames.shape[-2:])}; pad the frames")
        return self.encoder_skip(frames) + self.encoder(frames)

    def decode(self, latents: Tensor) -> Tensor:
        """Latents [N,C,h,w], not normalized -> frames [N,3,8h,8w], about [-1,1]."""
        return self.decoder_skip(latents) + self.decoder(latents)

    def forward(self, frames: Tensor) -> Tensor:
        """`decode(encode(frames))`."""
        return self.decode(self.encode(frames))

    def normalized(self, latents: Tensor) -> Tensor:
        """(latents - mean) / std per channel, for latents [...,C,h,w]."""
        mean, std = self._statistics(latents)
        return (latents - mean) / std

    def denormalized(self, latents: Tensor) -> Tensor:
        """The inverse of `normalized`."""
        mean, std = self._statistics(latents)
        return latents * std + mean

    @property
    def cell_readout(self) -> Tensor:
        """[12,C+1], see `cell_colours`.

        Raises:
            ValueError: when the configuration has none.
        """
        if self.config.cell_readout is None:
            raise ValueError("expected cell_readout in the configuration, got none; finish the autoencoder's training")
        return torch.tensor(self.config.cell_readout)

    def _statistics(self, like: Tensor) -> tuple[Tensor, Tensor]:
        if self.config.latents_mean is None or self.config.latents_std is None:
            raise ValueError(
                "expected latents_mean and latents_std in the configuration, got none; finish its training"
            )
        mean = torch.tensor(self.config.latents_mean, dtype=like.dtype, device=like.device)[:, None, None]
        return mean, torch.tensor(self.config.latents_std, dtype=like.dtype, device=like.device)[:, None, None]
