"""What the fine-tuning's rank and steps cost and buy: how like the subject the prior draws them afterwards."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import torch
from torch import Tensor

from ahoy_core.conventions import GREY
from ahoy_core.prior.clips import GARMENTS, Clips, region_weight
from ahoy_core.prior.conditioning import Context
from ahoy_core.prior.config import IdentityConfig
from ahoy_core.prior.corpus.prompts import NEUTRAL
from ahoy_core.prior.evidence import Frames
from ahoy_core.prior.identity import borrowed, train_identity
from ahoy_core.prior.inversion import clean_up
from ahoy_core.prior.light import lit
from ahoy_core.prior.scores import colour_distance, psnr
from ahoy_core.prior.text import IDENTITY_PROMPT
from ahoy_core.prior.video import VideoModel

_LATE: Final = 20  # steps that a row's loss is the mean of
_SHOWN: Final = -0.2  # cosine of the azimuth from which a corpus clip's view is taken for seen: backs are held back


@dataclass(frozen=True)
class Subject:
    """One person: what a video showed, and the truth.

    Attributes:
        name: of the row.
        seen: frames for the fine-tuning.
        views: T whole person images with bodies and azimuths.
        garments: name -> [T,1,H,W] alpha of it in `views`.
        held_back: [T] bool, views from sides that `seen` does not show.
        light: [T,1,H,W] on `views`, which `seen` is without (`ahoy_core.prior.light`); None: `seen` is as lit as they.
    """

    name: str
    seen: Frames
    views: Frames
    garments: Mapping[str, Tensor]
    held_back: Tensor
    light: Tensor | None = None


def corpus_subjects(clips: Clips, split: str) -> list[Subject]:
    """People of the corpus: views from the front are what a video showed, as far as the coarse avatar was observed."""
    return [_corpus_subject(clips, number, f"{split} {number}") for number in range(len(clips))]


def _corpus_subject(clips: Clips, number: int, name: str) -> Subject:
    visible = torch.minimum(clips.coverage, clips.mask)[number]
    shown = torch.cos(clips.azimuth[number]) > _SHOWN
    images = clips.frames[number] * visible + GREY * (1 - visible)
    body, azimuth = clips.body[number], clips.azimuth[number]
    return Subject(
        name,
        Frames(images[shown], visible[shown], body[shown], azimuth[shown]),
        Frames(clips.frames[number], clips.mask[number], body, azimuth),
        {garment: region_weight(clips, garment)[number] for garment in GARMENTS},
        ~shown,
    )


@torch.no_grad()
def generated(video: VideoModel, views: Frames, prompt: str, front: bool = False, seed: int = 0) -> Tensor:
    """Posterior mean of a subject's views [T,3,H,W], with the first held or from nothing but words and bodies.

    Raises:
        ValueError: the views have no body maps.
    """
    if views.body is None or views.azimuth is None:
        raise ValueError("expected views with body maps and azimuths, got none; make them with `subject_frames`")
    known = video.encode(views.images.transpose(0, 1)[None])
    held = torch.zeros(1, known.shape[2], known.shape[3] // 2, known.shape[4] // 2, dtype=torch.bool)
    held[:, 0] = front
    context = Context(video.embed([prompt]), known, held, views.body[None], views.azimuth[None])
    noise = torch.randn(known.shape, generator=torch.Generator().manual_seed(seed))
    return video.decode(clean_up(video, noise, context, 1).latents)[0].transpose(0, 1)


def likeness(made: Tensor, subject: Subject) -> dict[str, float]:
    """How like a subject the generated views are.

    Args:
        made: [T,3,H,W], in the light of `seen`.
        subject: whose views.

    Returns:
        `colour_distance/GARMENT` (0 to sqrt 3) over all views, `light_apart/GARMENT` the same at one brightness,
        `psnr_held_back` in dB over the person in the views that were held back.
    """
    views, found = subject.views, {}
    made = lit(made, views.visible, subject.light)
    for name, weight in subject.garments.items():
        for key, apart in (("colour_distance", False), ("light_apart", True)):
            found[f"{key}/{name}"] = float(colour_distance(made, views.images, weight, apart))
    back = subject.held_back
    found["psnr_held_back"] = float(psnr(made[back], views.images[back], views.visible[back]).nanmean())
    return found


def identity_curve(
    video: VideoModel,
    subject: Subject,
    ranks: Sequence[int],
    steps: Sequence[int],
    base: IdentityConfig | None = None,
) -> list[dict[str, Any]]:
    """Fine-tunes a subject once a rank, and looks after every so many steps: nothing else depends on how many follow.

    Args:
        video: without an adapter; given back without one.
        subject: who.
        ranks: of the low-rank updates.
        steps: after which to look.
        base: the other knobs.

    Returns:
        Rows: subject, rank, steps, loss (mean of the last `_LATE` steps), cpu_seconds of the training alone, and
        `likeness`. The first is of the prior as it was: rank 0, steps 0.
    """
    base = base or IdentityConfig()
    before = likeness(generated(video, subject.views, NEUTRAL), subject)
    rows: list[dict[str, Any]] = [{"subject": subject.name, "rank": 0, "steps": 0, "cpu_seconds": 0.0, **before}]
    for rank in ranks:
        look = _Look(video, subject, frozenset(steps))
        with borrowed(video):
            config = base.model_copy(update={"rank": rank, "steps": max(steps)})
            losses = train_identity(video, subject.seen, config, look).losses
        for row in look.rows:
            late = losses[max(0, row["steps"] - _LATE) : row["steps"]]
            rows.append({"subject": subject.name, "rank": rank, **row, "loss": float(late.mean())})
    return rows


class _Look:
    """Told of every step done, it scores the model after some; the time that takes is not the training's."""

    def __init__(self, video: VideoModel, subject: Subject, steps: frozenset[int]) -> None:
        self.video, self.subject, self.steps = video, subject, steps
        self.rows: list[dict[str, Any]] = []
        self.started = time.process_time()

    def __call__(self, done: int) -> None:
        if done not in self.steps:
            return
        spent = time.process_time() - self.started
        made = generated(self.video, self.subject.views, IDENTITY_PROMPT)
        self.rows.append({"steps": done, "cpu_seconds": spent, **likeness(made, self.subject)})
        self.started = time.process_time() - spent


def mean_rows(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Rows of several subjects -> one a rank and steps, with the number of `subjects` that it is the mean of."""
    groups: dict[tuple[int, int], list[Mapping[str, Any]]] = {}
    for row in rows:
        groups.setdefault((row["rank"], row["steps"]), []).append(row)
    means: list[dict[str, Any]] = []
    for (rank, steps), group in groups.items():
        names = [name for name in group[0] if name not in ("subject", "rank", "steps")]
        figures = {name: float(torch.tensor([row[name] for row in group]).nanmean()) for name in names}
        means.append({"rank": rank, "steps": steps, "subjects": len(group), **figures})
    return means
