"""Training of the autoencoder on crops of the corpus' frames; later of its decoder alone, latents unchanged."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from ahoy_core.conventions import GREY
from ahoy_core.prior.autoencoder import FrameAutoencoder
from ahoy_core.prior.bodymaps import CELL
from ahoy_core.prior.conditioning import FACTOR
from ahoy_core.prior.corpus.shards import read_shard, shards
from ahoy_core.prior.train.loop import Row

Array = NDArray[Any]

CROP = 64  # pixels: most of a person image is background
_POOL = 6  # shards in memory
_RENEW = 40  # steps after which one of them is replaced
_NOISE = 0.05  # on latents (of standard deviation about 1), so that the flow's small errors decode to small errors


class FramePool:
    """Random crops of frames of the training split.

    Args:
        folder: of the corpus; shards that appear during training are used as well.
        seed: of the draws.
    """

    def __init__(self, folder: Path, seed: int) -> None:
        self.folder, self.rng = folder, np.random.default_rng(seed)
        self._shards: list[dict[str, Array]] = []

    def batch(self, step: int, size: int) -> tuple[Tensor, Tensor]:
        """Crops [N,3,64,64] in [-1,1] and masks [N,1,64,64]; a few are coarse pictures, a few have grey holes."""
        if len(self._shards) < _POOL or step % _RENEW == 0:
            self._renew()
        frames, masks = np.empty((size, CROP, CROP, 3), np.uint8), np.empty((size, CROP, CROP), np.uint8)
        for k in range(size):
            shard = self._shards[int(self.rng.integers(len(self._shards)))]
            clip, frame = int(self.rng.integers(len(shard["image"]))), int(self.rng.integers(shard["image"].shape[1]))
            source = shard["coarse" if self.rng.random() < 0.15 else "image"][clip, frame]
            mask = shard["mask"][clip, frame]
            top = self._window(mask)
            frames[k], masks[k] = source[top : top + CROP], mask[top : top + CROP]
            if self.rng.random() < 0.1:
                row, column = int(self.rng.integers(0, CROP - 8)), int(self.rng.integers(0, CROP - 8))
                frames[
                    k, row : row + int(self.rng.integers(8, 40)), column : column + int(self.rng.integers(8, 64))
                ] = round(255 * GREY)
            if self.rng.random() < 0.5:
                frames[k], masks[k] = frames[k, :, ::-1], masks[k, :, ::-1]
        return to_model(frames), torch.from_numpy(masks)[:, None].float() / 255

    def _window(self, mask: Array) -> int:
        """The first row of a crop that holds some of the person."""
        rows = np.flatnonzero(mask.max(1) > 127)
        middle = int(self.rng.choice(rows)) if len(rows) else mask.shape[0] // 2
        return int(np.clip(middle - self.rng.integers(8, CROP - 8), 0, mask.shape[0] - CROP))

    def _renew(self) -> None:
        paths = shards(self.folder, "train")
        if not paths:
            raise FileNotFoundError(
                f"expected training shards in {str(self.folder)!r}, got none; run ahoy prior corpus"
            )
        arrays, _ = read_shard(paths[int(self.rng.integers(len(paths)))], ("image", "mask", "coarse"))
        self._shards = [*self._shards[-(_POOL - 1) :], arrays]


def to_model(frames: Array) -> Tensor:
    """uint8 [...,H,W,3] -> float32 [...,3,H,W] in [-1,1]."""
    return torch.from_numpy(np.ascontiguousarray(np.moveaxis(frames, -1, -3))).float() / 127.5 - 1


def autoencoder_loss(
    model: FrameAutoencoder, frames: Tensor, masks: Tensor, generator: torch.Generator
) -> tuple[Tensor, Row]:
    """L1 and L2 on colours and L1 on their differences, four times as much on the person as on the background.

    Args:
        model: in training; with a frozen encoder only the decoder learns.
        frames: [N,3,H,W] in [-1,1].
        masks: [N,1,H,W] alpha.
        generator: of the noise on the latents.

    Returns:
        The loss, and the PSNR inside the mask (peak 2).
    """
    latents = model.encode(frames)
    noisy = latents + _NOISE * torch.randn(latents.shape, generator=generator)
    error = model.decode(noisy) - frames
    weight = 0.25 + nn.functional.max_pool2d(masks, 5, 1, 2)
    value = 3 * (error.square() * weight).mean() + 0.5 * (error.abs() * weight).mean()
    value = value + 0.5 * (error.diff(dim=-1).abs() * weight[..., 1:]).mean()
    value = value + 0.5 * (error.diff(dim=-2).abs() * weight[..., 1:, :]).mean()
    mean, std = latents.mean((0, 2, 3)), latents.std((0, 2, 3))
    value = (
        value + 1e-3 * (mean.square() + (std - 1).square()).mean() + 1e-3 * nn.functional.relu(latents.abs() - 4).mean()
    )
    return value, {"psnr_mask": masked_psnr(error.detach(), masks)}


@torch.no_grad()
def start_from_principal_components(model: FrameAutoencoder, frames: Tensor, masks: Tensor) -> None:
    """Makes the linear path the principal component analysis of 8x8 patches on people, with latents of deviation 1.

    Args:
        model: untrained: its convolutions add nothing yet.
        frames: [N,3,H,W] in [-1,1]; some hundred crops.
        masks: [N,1,H,W] alpha.
    """
    patches = nn.functional.pixel_unshuffle(frames, FACTOR).permute(0, 2, 3, 1)
    patches = patches[nn.functional.avg_pool2d(masks, FACTOR)[:, 0] > 0.05]
    mean = patches.mean(0)
    deviations, basis = torch.linalg.svd(patches - mean, full_matrices=False)[1:]
    count = model.config.latent_channels
    deviations, basis = deviations[:count, None] / len(patches) ** 0.5, basis[:count]
    encode: Any = model.encoder_skip[1]
    decode: Any = model.decoder_skip[0]
    encode.weight.copy_((basis / deviations)[..., None, None])
    encode.bias.copy_(-(basis / deviations) @ mean)
    decode.weight.copy_((basis * deviations).T[..., None, None])
    decode.bias.copy_(mean)


def masked_psnr(error: Tensor, masks: Tensor) -> float:
    """PSNR in dB (peak 2) of errors [N,3,H,W] inside masks [N,1,H,W]."""
    mean = float((error.square() * masks).sum() / (3 * masks.sum()).clamp(min=1e-6))
    return 10 * float(np.log10(4 / max(mean, 1e-12)))


@torch.no_grad()
def autoencoder_psnr(model: FrameAutoencoder, path: Path, frames: int = 64) -> float:
    """Mean over frames of the PSNR inside the mask on evenly spread frames of a shard."""
    arrays, _ = read_shard(path, ("image", "mask"))
    index = np.linspace(0, len(arrays["image"]) - 1, frames).astype(int), np.arange(frames) % arrays["image"].shape[1]
    pictures, masks = to_model(arrays["image"][index]), torch.from_numpy(arrays["mask"][index])[:, None].float() / 255
    restored = model.decode(model.encode(pictures)).clamp(-1, 1)
    return float(np.mean([masked_psnr((restored - pictures)[k : k + 1], masks[k : k + 1]) for k in range(frames)]))


@torch.no_grad()
def latent_statistics(model: FrameAutoencoder, folder: Path, shards_used: int = 4) -> tuple[list[float], list[float]]:
    """Mean and standard deviation of each latent channel where people are, over some training shards.

    The background, three quarters of a picture, is one constant: it would make people look like outliers.
    """
    latents = torch.cat([found for found, _ in _people(model, folder, shards_used)])
    return latents.mean(0).tolist(), latents.std(0).tolist()


@torch.no_grad()
def fitted_readout(model: FrameAutoencoder, folder: Path, shards_used: int = 4) -> list[list[float]]:
    """[12,C+1] by least squares: a normalized latent to the mean colours of its cells, where people are."""
    pairs = list(_people(model, folder, shards_used))
    latents = model.normalized(torch.cat([found for found, _ in pairs])[..., None, None])[..., 0, 0]
    known = torch.cat([latents, torch.ones(len(latents), 1)], 1)
    solution: Tensor = torch.linalg.lstsq(known, torch.cat([colours for _, colours in pairs])).solution
    return solution.T.tolist()


def _people(model: FrameAutoencoder, folder: Path, shards_used: int) -> Iterator[tuple[Tensor, Tensor]]:
    """Latents [N,C] that show some of a person, as the encoder gives them, and their cells' mean colours [N,12]."""
    for path in shards(folder, "train")[:shards_used]:
        arrays, _ = read_shard(path, ("image", "mask"))
        for clip, mask in zip(arrays["image"][::16], arrays["mask"][::16], strict=True):
            there = nn.functional.avg_pool2d(torch.from_numpy(mask)[:, None].float() / 255, FACTOR)[:, 0] > 0.05
            pictures = to_model(clip)
            cells = nn.functional.pixel_unshuffle(nn.functional.avg_pool2d(pictures, CELL), FACTOR // CELL)
            yield model.encode(pictures).permute(0, 2, 3, 1)[there], cells.permute(0, 2, 3, 1)[there]
