"""The corpus as the flow sees it: latents of pictures and coarse pictures, coverage and body maps, a file a shard."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from ahoy_core.formats.atomic import atomic_path
from ahoy_core.prior.autoencoder import FrameAutoencoder
from ahoy_core.prior.conditioning import FACTOR, held_tokens
from ahoy_core.prior.corpus.shards import read_shard
from ahoy_core.prior.train.frames import to_model

Array = NDArray[Any]

_PROBE: Final = 0.2  # of a channel's deviation: small enough for the decoder to be nearly linear
_LEAST_WEIGHT: Final = 0.3  # of the mean: grain is still learned, samples need it

_ARRAYS: Final = ("image", "coarse", "mask", "coverage", "body", "azimuth", "observed")


@dataclass(frozen=True)
class LatentClips:
    """Clips of one or more shards, N of T frames.

    Attributes:
        pictures: [N,T,C,h,w] float16, normalized latents.
        coarse: [N,T,C,h,w] float16.
        weight: [N,T,h,w] float16 share of person in each latent.
        coverage: [N,T,h,w] float16 observed share of each latent.
        held: [N,T,h/2,w/2] bool tokens that the coverage allows to hold.
        body: [N,T,7,2h,2w] int8.
        azimuth: [N,T] float32.
        observed: [N,T] uint8.
        prompts: N captions.
    """

    pictures: Tensor
    coarse: Tensor
    weight: Tensor
    coverage: Tensor
    held: Tensor
    body: Tensor
    azimuth: Tensor
    observed: Tensor
    prompts: list[str]

    def __len__(self) -> int:
        return len(self.pictures)


@torch.no_grad()
def encode_shard(vae: FrameAutoencoder, shard: Path, folder: Path, every: int = 1) -> Path:
    """Writes the latents of a shard to `folder`, unless they are there.

    Args:
        vae: with latent statistics.
        shard: of the corpus.
        folder: of latents; exists.
        every: take every so many clips; neighbours differ in paint and light alone.
    """
    path = folder / shard.name
    if path.exists():
        return path
    arrays, meta = read_shard(shard, _ARRAYS)
    arrays = {name: np.ascontiguousarray(array[::every]) for name, array in arrays.items()}
    mask = torch.from_numpy(arrays["mask"]).float() / 255
    coverage = torch.from_numpy(arrays["coverage"]).float() / 255
    tensors = {
        "pictures": _encoded(vae, arrays["image"]),
        "coarse": _encoded(vae, arrays["coarse"]),
        "weight": nn.functional.avg_pool2d(mask, FACTOR).half(),
        "coverage": nn.functional.avg_pool2d(torch.minimum(coverage, mask), FACTOR).half(),
        "held": held_tokens(coverage, mask),
        **{name: torch.from_numpy(arrays[name]) for name in ("body", "azimuth", "observed")},
    }
    with atomic_path(path) as temporary:
        save_file(tensors, temporary, {"ahoy": json.dumps({"prompts": meta["prompts"][::every]})})
    return path


def read_latents(path: Path) -> LatentClips:
    """Reads what `encode_shard` wrote."""
    with safe_open(path, "pt") as handle:
        prompts = json.loads(handle.metadata()["ahoy"])["prompts"]
        return LatentClips(**{name: handle.get_tensor(name) for name in handle.keys()}, prompts=prompts)  # noqa: SIM118


def _encoded(vae: FrameAutoencoder, frames: Array) -> Tensor:
    clips = [vae.normalized(vae.encode(to_model(clip))).half() for clip in frames]
    return torch.stack(clips)


@torch.no_grad()
def pixel_weights(vae: FrameAutoencoder, clips: LatentClips, frames: int = 64) -> Tensor:
    """How much an error of each latent channel is worth in pixels [C], with mean 1.

    Normalized channels are alike in size and not in what they draw: the first, the brightness of eight pixels by eight,
    moves pixels forty times as much as the last. A loss that takes them alike spends a small network on grain.

    Args:
        vae: whose latents these are.
        clips: of people.
        frames: how many are tried.
    """
    pictures, person = clips.pictures.flatten(0, 1), clips.weight.flatten(0, 1)
    chosen = torch.linspace(0, len(pictures) - 1, frames).long()
    latents, person = pictures[chosen].float(), person[chosen].float()
    inside = nn.functional.interpolate(person[:, None], scale_factor=FACTOR)
    before = vae.decode(vae.denormalized(latents))
    signs = torch.randn(latents[:, :1].shape, generator=torch.Generator().manual_seed(0))
    moved = []
    for channel in range(latents.shape[1]):
        changed = latents.clone()
        changed[:, channel : channel + 1] += _PROBE * signs
        moved.append(((vae.decode(vae.denormalized(changed)) - before).square() * inside).sum())
    weights = torch.stack(moved)
    weights = (weights / weights.mean()).clamp(min=_LEAST_WEIGHT)
    return weights / weights.mean()


class LatentPool:
    """All latents of a folder in memory; files that appear later are taken in.

    Args:
        folder: of latents.
        split: of the corpus.
        seed: of the draws.
    """

    def __init__(self, folder: Path, split: str, seed: int) -> None:
        self.folder, self.split, self.rng = folder, split, np.random.default_rng(seed)
        self._clips: dict[str, LatentClips] = {}
        self.refresh()

    def refresh(self) -> int:
        """Reads new files; returns the number of clips."""
        for path in sorted(self.folder.glob(f"{self.split}-*.safetensors")):
            if path.name not in self._clips:
                self._clips[path.name] = read_latents(path)
        if not self._clips:
            raise FileNotFoundError(
                f"expected latents of {self.split!r} in {str(self.folder)!r}, got none; encode first"
            )
        return sum(len(clips) for clips in self._clips.values())

    def some(self) -> LatentClips:
        """The clips of the first file."""
        return next(iter(self._clips.values()))

    def draw(self, size: int) -> list[tuple[LatentClips, int]]:
        """Random clips, as (file, index)."""
        files = list(self._clips.values())
        drawn = [files[int(k)] for k in self.rng.integers(len(files), size=size)]
        return [(clips, int(self.rng.integers(len(clips)))) for clips in drawn]
