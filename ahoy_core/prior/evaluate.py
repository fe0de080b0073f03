"""What the prior is worth on people it has never seen: turning round, cleaning up, going there and back."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ahoy_core.metrics.perceptual import Perceptual
from ahoy_core.prior.clips import GARMENTS, REGIONS, Clips, context_of, load_clips, region_weight
from ahoy_core.prior.conditioning import Context, held_tokens
from ahoy_core.prior.config import InversionConfig
from ahoy_core.prior.corpus.dress import KINDS
from ahoy_core.prior.corpus.shards import shards
from ahoy_core.prior.corpus.wardrobe import SPLITS
from ahoy_core.prior.inversion import Hallucination, clean_up, hallucinate
from ahoy_core.prior.scores import NO_PERCEPTUAL, colour_distance, gradient_energy, perceptual_distance, psnr
from ahoy_core.prior.train.frames import autoencoder_psnr
from ahoy_core.prior.video import VideoModel

Repair = Callable[[Tensor, Context], Hallucination]
"""Coarse latents [B,C,T,h,w] and all that is known (with coarse latents) -> a hallucinated video."""


def held_out(
    video: VideoModel,
    corpus: Path,
    clips: int,
    splits: Sequence[str] = SPLITS,
    perceptual: Perceptual | None = None,
) -> dict[str, Any]:
    """Figures on the first shard of each split that the prior was not trained on.

    Args:
        video: the prior.
        corpus: folder of shards.
        clips: of each split, at most.
        splits: which; the training's own is left out.
        perceptual: network; without one the figures say that its distances were not measured.
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
                for region in GARMENTS
            },
            "perceptual": NO_PERCEPTUAL if perceptual is None else perceptual.name,
            "repaired": repaired(video, load_clips(paths[0], clips, turning=False), repair_methods(video), perceptual),
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
    video: VideoModel,
    clips: Clips,
    methods: Mapping[str, Repair],
    perceptual: Perceptual | None = None,
) -> dict[str, float]:
    """Coarse turns against the truth, before and after each method, on unobserved and on observed surface.

    Args:
        video: the prior.
        clips: held-out clips.
        methods: name -> repair.
        perceptual: network.

    Returns:
        `METHOD/unobserved`, `METHOD/observed` mean PSNR in dB over frames (before compositing), `METHOD/gradient` on
        unobserved surface as a share of the truth's, `METHOD/colour GARMENT` the mean over clips of the distance of a
        garment's mean colour there to the truth's, and with a network `METHOD/perceptual` the mean distance there.
    """
    coverage = torch.minimum(clips.coverage, clips.mask)
    held = held_tokens(coverage[:, :, 0], clips.mask[:, :, 0])
    context = context_of(video, clips, held, coarse=True, frames=clips.coarse)
    unseen = (clips.mask - coverage).clamp(min=0)
    figures = {}
    coarse = context.coarse
    assert coarse is not None
    results = {"coarse": clips.coarse, "coarse coded": video.decode(coarse).transpose(1, 2)}
    results |= {name: video.decode(method(coarse, context).latents).transpose(1, 2) for name, method in methods.items()}
    for name, pictures in results.items():
        figures[f"{name}/unobserved"] = float(torch.nanmean(psnr(pictures, clips.frames, unseen)))
        figures[f"{name}/observed"] = float(torch.nanmean(psnr(pictures, clips.frames, coverage)))
        figures[f"{name}/gradient"] = gradient_energy(pictures, unseen) / max(
            gradient_energy(clips.frames, unseen), 1e-9
        )
        for garment in GARMENTS:
            hidden = torch.minimum(region_weight(clips, garment), unseen)
            distance = colour_distance(pictures, clips.frames, hidden)
            figures[f"{name}/colour {garment}"] = float(torch.nanmean(distance))
        if perceptual is not None:
            flat = (pictures.flatten(0, 1), clips.frames.flatten(0, 1), unseen.flatten(0, 1))
            figures[f"{name}/perceptual"] = float(torch.nanmean(perceptual_distance(perceptual, *flat)))
    return figures


def repair_methods(video: VideoModel, seed: int = 0) -> dict[str, Repair]:
    """Clean-up in one and in eight steps, and RF-inversion at several depths."""

    def cleaned(steps: int) -> Repair:
        def method(coarse: Tensor, context: Context) -> Hallucination:
            noise = torch.randn(coarse.shape, generator=torch.Generator().manual_seed(seed))
            return clean_up(video, noise, context, steps)

        return method

    return {
        "clean-up 1 step": cleaned(1),
        "clean-up 8 steps": cleaned(8),
        "inversion 0.6": inverted(video, InversionConfig(tau_max=0.6, gamma=0.0, steps=6), seed),
        "inversion 0.8, gamma 0.5": inverted(video, InversionConfig(tau_max=0.8, gamma=0.5, steps=6), seed),
    }


def inverted(video: VideoModel, config: InversionConfig, seed: int = 0) -> Repair:
    """RF-inversion as a repair: what was observed is held, coarse latents are gone through and not read."""

    def method(coarse: Tensor, context: Context) -> Hallucination:
        neutral = video.embed([""]).expand(len(coarse), -1, -1)
        generator = torch.Generator().manual_seed(seed)
        blind = Context(context.text, context.known, context.held, context.body, context.azimuth)
        return hallucinate(video, coarse, blind, neutral, config, generator)

    return method


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
        video.decode(method(context.coarse, context).latents)
        seconds[name] = time.process_time() - start
    return seconds
