"""What the prior is worth on people it has never seen: turning round, cleaning up, going there and back."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ahoy_core.prior.conditioning import Context, held_tokens
from ahoy_core.prior.config import InversionConfig
from ahoy_core.prior.corpus.dress import KINDS, Kind
from ahoy_core.prior.corpus.prompts import NEUTRAL
from ahoy_core.prior.corpus.shards import read_shard, shards
from ahoy_core.prior.corpus.wardrobe import SPLITS
from ahoy_core.prior.inversion import clean_up, hallucinate
from ahoy_core.prior.train.frames import autoencoder_psnr
from ahoy_core.prior.video import VideoModel

Array = NDArray[Any]

REGIONS: Final[dict[str, tuple[Kind, ...]]] = {
    "torso": ("upper",),
    "legs": ("lower",),
    "head": ("skin", "hair", "eyes", "brows"),
}
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
    """Evenly spread clips of a shard; with `turning`, those that start in front and show the back."""
    names = ("image", "mask", "part", "coarse", "coverage", "body", "azimuth")
    arrays, _ = read_shard(shard, names)
    chosen = np.arange(len(arrays["azimuth"]))
    if turning:
        front = np.abs(_wrapped(arrays["azimuth"][:, 0])) < _FRONT
        back = np.abs(_wrapped(arrays["azimuth"] - math.pi)).min(1) < _BACK
        chosen = np.flatnonzero(front & back)
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


def psnr(made: Tensor, truth: Tensor, weight: Tensor) -> Tensor:
    """PSNR in dB (peak 1) of pictures [...,3,H,W] under weights [...,1,H,W], one a picture; NaN where none counts."""
    area = weight.sum((-1, -2, -3))
    error = ((made - truth).square() * weight).sum((-1, -2, -3)) / (3 * area)
    return torch.where(area >= 20, -10 * torch.log10(error.clamp(min=1e-10)), torch.full_like(area, math.nan))


def gradient_energy(pictures: Tensor, weight: Tensor) -> float:
    """Mean squared difference of neighbouring pixels inside weights: how sharp pictures are."""
    across = (pictures.diff(dim=-1).square() * weight[..., 1:] * weight[..., :-1]).sum()
    down = (pictures.diff(dim=-2).square() * weight[..., 1:, :] * weight[..., :-1, :]).sum()
    return float((across + down) / (6 * weight.sum()).clamp(min=1))


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


def held_out(video: VideoModel, corpus: Path, clips: int, splits: Sequence[str] = SPLITS) -> dict[str, Any]:
    """Figures on the first shard of each split that the prior was not trained on.

    Args:
        video: the prior.
        corpus: folder of shards.
        clips: of each split, at most.
        splits: which; the training's own is left out.
    """
    found: dict[str, Any] = {}
    for split in SPLITS:
        paths = shards(corpus, split)
        if not paths or split == "train" or split not in splits:
            continue
        turns = load_clips(paths[0], clips)
        back = back_from_front(video, turns)
        found[split] = {
            "autoencoder_psnr_mask": autoencoder_psnr(video.components.vae, paths[0]),
            "clips": len(turns),
            "back_from_front": back,
            "back_gain": {
                f"{made} over {base}, {region}": back[f"{made}/{region}"] - back[f"{base}/{region}"]
                for made in ("mean", "sample")
                for base in ("mirror", "colours")
                for region in ("torso", "legs")
            },
            "repaired": repaired(video, load_clips(paths[0], clips, turning=False), repair_methods(video)),
            "cpu_seconds": sequence_seconds(video, turns.take(1)),
        }
    return found


@torch.no_grad()
def back_from_front(video: VideoModel, clips: Clips, steps: int = 12, seed: int = 0) -> dict[str, float]:
    """The back view from the front one: posterior mean, sample, mirror and mean colours, by region.

    Args:
        video: the prior.
        clips: held-out turns whose first frame is the front.
        steps: midpoint steps of a sample.
        seed: of the noise.

    Returns:
        `METHOD/REGION` -> mean PSNR in dB of the back views; `METHOD/gradient` -> gradient energy inside the person,
        as a share of the truth's.
    """
    held = torch.zeros(*clips.part.shape[:2], clips.part.shape[2] // 16, clips.part.shape[3] // 16, dtype=torch.bool)
    held[:, 0] = True
    context = context_of(video, clips, held, coarse=False)
    noise = torch.randn(context.known.shape, generator=torch.Generator().manual_seed(seed))  # type: ignore[union-attr]
    mean = clean_up(video, noise, context, steps=1).latents
    sample = clean_up(video, noise, context, steps=steps, solver="midpoint").latents
    rows, back = torch.arange(len(clips)), torch.cos(clips.azimuth).argmin(1)
    truth, mask = clips.frames[rows, back], clips.mask[rows, back]
    made = {
        "mean": video.decode(mean).transpose(1, 2)[rows, back],
        "sample": video.decode(sample).transpose(1, 2)[rows, back],
        "mirror": mirrored_front(clips)[rows, back],
        "colours": mean_colours(clips)[rows, back],
        "ceiling": video.decode(context.known).transpose(1, 2)[rows, back],  # type: ignore[arg-type]
    }
    figures = {}
    for name, pictures in made.items():
        for region in REGIONS:
            weight = region_weight(clips, region)[rows, back]
            figures[f"{name}/{region}"] = float(torch.nanmean(psnr(pictures, truth, weight)))
        figures[f"{name}/gradient"] = gradient_energy(pictures, mask) / max(gradient_energy(truth, mask), 1e-9)
    return figures


def mirrored_front(clips: Clips) -> Tensor:
    """The front mirrored into every frame; where it has a hole, its row's mean colour (fair to the silhouette)."""
    front, mask = clips.frames[:, :1].flip(-1), (clips.mask[:, :1].flip(-1) > 0.5).float()
    row = (front * mask).sum(-1, keepdim=True) / mask.sum(-1, keepdim=True).clamp(min=1)
    return (front * mask + row * (1 - mask)).expand_as(clips.frames)


def mean_colours(clips: Clips) -> Tensor:
    """Each material in the mean colour that the front shows of it (grey where it shows none)."""
    made = torch.full_like(clips.frames, 0.5)
    for kind in range(len(KINDS)):
        there = (clips.part == kind)[:, :, None].float()
        front = there[:, :1] * clips.mask[:, :1]
        area = front.sum((-1, -2), keepdim=True)
        colour = (clips.frames[:, :1] * front).sum((-1, -2), keepdim=True) / area.clamp(min=1)
        made = torch.where((there > 0) & (area > 0), colour, made)
    return made


@torch.no_grad()
def repaired(
    video: VideoModel, clips: Clips, methods: Mapping[str, Callable[[Tensor, Context], Tensor]]
) -> dict[str, float]:
    """Coarse turns against the truth, before and after each method, on unobserved and on observed surface.

    Args:
        video: the prior.
        clips: held-out clips.
        methods: name -> (coarse latents, context) -> latents.

    Returns:
        `METHOD/unobserved`, `METHOD/observed` mean PSNR in dB over frames (before compositing), `METHOD/gradient` on
        unobserved surface as a share of the truth's.
    """
    coverage = torch.minimum(clips.coverage, clips.mask)
    held = held_tokens(coverage[:, :, 0], clips.mask[:, :, 0])
    context = context_of(video, clips, held, coarse=True, frames=clips.coarse)
    unseen = (clips.mask - coverage).clamp(min=0)
    figures = {}
    coarse = context.coarse
    assert coarse is not None
    results = {"coarse": clips.coarse, "coarse coded": video.decode(coarse).transpose(1, 2)}
    results |= {name: video.decode(method(coarse, context)).transpose(1, 2) for name, method in methods.items()}
    for name, pictures in results.items():
        figures[f"{name}/unobserved"] = float(torch.nanmean(psnr(pictures, clips.frames, unseen)))
        figures[f"{name}/observed"] = float(torch.nanmean(psnr(pictures, clips.frames, coverage)))
        figures[f"{name}/gradient"] = gradient_energy(pictures, unseen) / max(
            gradient_energy(clips.frames, unseen), 1e-9
        )
    return figures


def repair_methods(video: VideoModel, seed: int = 0) -> dict[str, Callable[[Tensor, Context], Tensor]]:
    """Clean-up in one and in eight steps, and RF-inversion at several depths."""

    def cleaned(steps: int) -> Callable[[Tensor, Context], Tensor]:
        def method(coarse: Tensor, context: Context) -> Tensor:
            noise = torch.randn(coarse.shape, generator=torch.Generator().manual_seed(seed))
            return clean_up(video, noise, context, steps).latents

        return method

    def inverted(tau_max: float, gamma: float) -> Callable[[Tensor, Context], Tensor]:
        config = InversionConfig(tau_max=tau_max, gamma=gamma, steps=6)

        def method(coarse: Tensor, context: Context) -> Tensor:
            neutral = video.embed([""]).expand(len(coarse), -1, -1)
            generator = torch.Generator().manual_seed(seed)
            blind = Context(context.text, context.known, context.held, context.body, context.azimuth)
            return hallucinate(video, coarse, blind, neutral, config, generator).latents

        return method

    return {
        "clean-up 1 step": cleaned(1),
        "clean-up 8 steps": cleaned(8),
        "inversion 0.6": inverted(0.6, 0.0),
        "inversion 0.8, gamma 0.5": inverted(0.8, 0.5),
    }


@torch.no_grad()
def sequence_seconds(video: VideoModel, clip: Clips) -> dict[str, float]:
    """CPU seconds that each method takes for one sequence, coding and decoding included."""
    coverage = torch.minimum(clip.coverage, clip.mask)
    held = held_tokens(coverage[:, :, 0], clip.mask[:, :, 0])
    seconds = {}
    for name, method in repair_methods(video).items():
        start = time.process_time()
        context = context_of(video, clip, held, coarse=True, frames=clip.coarse)
        assert context.coarse is not None
        video.decode(method(context.coarse, context))
        seconds[name] = time.process_time() - start
    return seconds
