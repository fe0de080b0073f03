"""Held-out clips of the corpus: what is known of them, their garments, and the prior's context for them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ahoy_core.prior.conditioning import Context
from ahoy_core.prior.corpus.dress import KINDS, Kind
from ahoy_core.prior.corpus.prompts import NEUTRAL
from ahoy_core.prior.corpus.shards import read_shard
from ahoy_core.prior.video import VideoModel

Array = NDArray[Any]

REGIONS: Final[dict[str, tuple[Kind, ...]]] = {
    "torso": ("upper",),
    "legs": ("lower",),
    "head": ("skin", "hair", "eyes", "brows"),
}
GARMENTS: Final = ("torso", "legs")
_FRONT, _BACK = 0.35, 0.3  # radians: how far a front or back view may be from straight on
_HEAD_PLACE = 0.7  # of the body's height in [-1,1]: skin above it belongs to the head


@dataclass(frozen=True)
class Clips:
    """N held-out clips of T frames; colours and alphas in [0,1].

    Attributes:
        frames: [N,T,3,H,W] over grey.
        mask: [N,T,1,H,W].
        coverage: [N,T,1,H,W], 1 where the imagined video showed the surface.
        coarse: [N,T,3,H,W].
        part: [N,T,H,W] index into `KINDS`, 255 outside.
        body: [N,T,7,H/4,W/4].
        azimuth: [N,T] radians.
    """

    frames: Tensor
    mask: Tensor
    coverage: Tensor
    coarse: Tensor
    part: Tensor
    body: Tensor
    azimuth: Tensor

    def __len__(self) -> int:
        return len(self.frames)

    def take(self, count: int) -> Clips:
        """The first clips."""
        return Clips(**{name: value[:count] for name, value in self.__dict__.items()})

    def views(self, frames: list[int]) -> Clips:
        """The same clips with some of their frames."""
        return Clips(**{name: value[:, frames] for name, value in self.__dict__.items()})


def load_clips(shard: Path, limit: int, turning: bool = True) -> Clips:
    """Evenly spread clips of a shard; with `turning`, those that start in front and show a back without a print.

    Raises:
        ValueError: when the shard does not say who has a print on the back (its maker did not yet note it).
    """
    names = ("image", "mask", "part", "coarse", "coverage", "body", "azimuth")
    arrays, meta = read_shard(shard, names)
    chosen = np.arange(len(arrays["azimuth"]))
    if turning:
        front = np.abs(_wrapped(arrays["azimuth"][:, 0])) < _FRONT
        back = np.abs(_wrapped(arrays["azimuth"] - math.pi)).min(1) < _BACK
        if "back_prints" not in meta:
            raise ValueError(f"expected a shard that notes prints on backs, got {shard.name}; delete it, make it again")
        chosen = np.flatnonzero(front & back & ~np.array(meta["back_prints"], dtype=bool))
    chosen = chosen[np.linspace(0, len(chosen) - 1, min(limit, len(chosen))).astype(int)]

    def unit(name: str) -> Tensor:
        return torch.from_numpy(arrays[name][chosen]).float() / 255

    return Clips(
        frames=unit("image").permute(0, 1, 4, 2, 3),
        mask=unit("mask")[:, :, None],
        coverage=unit("coverage")[:, :, None],
        coarse=unit("coarse").permute(0, 1, 4, 2, 3),
        part=torch.from_numpy(arrays["part"][chosen]),
        body=torch.from_numpy(arrays["body"][chosen]).float() / 127,
        azimuth=torch.from_numpy(arrays["azimuth"][chosen]),
    )


def _wrapped(angle: Array) -> Array:
    return np.asarray((angle + math.pi) % (2 * math.pi) - math.pi)


def region_weight(clips: Clips, name: str) -> Tensor:
    """[N,T,1,H,W] alpha of a region; skin counts as head where the body's map says so."""
    inside = torch.isin(clips.part, torch.tensor([KINDS.index(kind) for kind in REGIONS[name]]))
    if name == "head":
        place = clips.body[:, :, 3] / clips.body[:, :, 0].clamp(min=1e-3)
        high = place.repeat_interleave(4, -1).repeat_interleave(4, -2) > _HEAD_PLACE
        skin = clips.part == KINDS.index("skin")
        inside &= ~skin | high
    return inside[:, :, None] * clips.mask


def context_of(
    video: VideoModel, clips: Clips, held: Tensor | None, coarse: bool, frames: Tensor | None = None
) -> Context:
    """The prior's context for clips: which tokens are held [N,T,h/2,w/2], and whether coarse latents are given."""
    known = video.encode((clips.frames if frames is None else frames).transpose(1, 2))
    factor = clips.frames.shape[-1] // known.shape[-1]
    seen = torch.nn.functional.avg_pool2d(torch.minimum(clips.coverage, clips.mask)[:, :, 0], factor)
    return Context(
        text=video.embed([NEUTRAL]).expand(len(clips), -1, -1),
        known=None if held is None else known,
        held=held,
        body=clips.body,
        azimuth=clips.azimuth,
        coarse=video.encode(clips.coarse.transpose(1, 2)) if coarse else None,
        coverage=seen if coarse else None,
    )
