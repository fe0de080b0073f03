"""May the prior be trusted on this video? Hide what was observed, let the fills compete, and believe the winner."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ahoy_core.prior.completion import Pictures

Array = NDArray[Any]
Fill = Callable[[Tensor], Pictures]
"""Which surface points stay observed [N] bool -> the pictures that a fill makes of them, with their coverage."""
Repaint = Callable[[Pictures], Tensor]
"""Pictures with guesses -> [T,3,H,W] with better ones."""

BASELINE: Final = "symmetric fill"
MARGIN: Final = 0.03
"""Share by which a fill must be closer than a simpler one: about what the winner moves by from one draw of eight
regions to the next (docs/prior.md). Two draws of two regions differ by more."""
_MIN_OBSERVED: Final = 40  # surface points: with fewer there is nothing to hide
_MIN_PIXELS: Final = 30


@dataclass(frozen=True)
class SelfCheck:
    """What the competition said.

    Attributes:
        errors: root mean square colour error in [0,1] on hidden pixels, by competitor.
        winner: see `winner_of`; the symmetric fill where nothing could be hidden.
        regions: hidden regions that were scored.
        pixels: hidden pixels that were scored, in all.
        note: why, where there was no competition.
    """

    errors: dict[str, float]
    winner: str
    regions: int
    pixels: int
    note: str = ""

    @property
    def confidence(self) -> float:
        """The winner's error; NaN where nothing could be hidden."""
        return self.errors.get(self.winner, float("nan"))


def hidden_region(points: Array, observed: Array, rng: np.random.Generator, share: float = 0.3) -> Array:
    """A connected piece of the observed surface: the nearest observed points round a drawn one.

    Args:
        points: [N,3] of the surface in canonical pose, metres.
        observed: [N] bool.
        rng: source of the draw.
        share: of the observed points to hide.

    Returns:
        [N] bool.
    """
    candidates = np.flatnonzero(observed)
    center = points[rng.choice(candidates)]
    distance = np.linalg.norm(points[candidates] - center, axis=1)
    hidden = np.zeros(len(points), dtype=bool)
    hidden[candidates[np.argsort(distance, kind="stable")[: round(share * len(candidates))]]] = True
    return hidden


def self_check(
    points: Array,
    observed: Array,
    fill: Fill,
    competitors: Mapping[str, Repaint],
    rng: np.random.Generator,
    regions: int = 3,
) -> SelfCheck:
    """Hides observed regions one after the other and scores every fill on what was hidden.

    Args:
        points: [N,3] surface points in canonical pose.
        observed: [N] bool.
        fill: the symmetric fill: from what stays observed to pictures.
        competitors: what repaints those pictures, by name, the simplest first.
        rng: source of the regions.
        regions: how many.
    """
    if int(observed.sum()) < _MIN_OBSERVED:
        note = f"only {int(observed.sum())} surface points were observed: nothing can be hidden"
        return SelfCheck({}, BASELINE, 0, 0, note)
    truth = fill(torch.from_numpy(observed))
    squares: dict[str, float] = dict.fromkeys([BASELINE, *competitors], 0.0)
    total = scored = 0.0
    for _ in range(regions):
        kept = observed & ~hidden_region(points, observed, rng)
        given = fill(torch.from_numpy(kept))
        weight = ((truth.coverage > 0.9) & (given.coverage < 0.1) & (truth.mask > 0.9)).float()
        if float(weight.sum()) < _MIN_PIXELS:
            continue
        scored, total = scored + 1, total + float(weight.sum())
        for name in squares:
            made = given.frames if name == BASELINE else competitors[name](given)
            squares[name] += float(((made - truth.frames).square().mean(1, keepdim=True) * weight).sum())
    if not scored:
        return SelfCheck({}, BASELINE, 0, 0, "no hidden region was large enough to be seen in the pictures")
    errors = {name: (value / total) ** 0.5 for name, value in squares.items()}
    return SelfCheck(errors, winner_of(errors), int(scored), int(total))


def winner_of(errors: Mapping[str, float]) -> str:
    """The simplest of what is as good as anything: each must be closer than the winner before it by `MARGIN`.

    Args:
        errors: by name, the simplest first.
    """
    winner, *others = errors
    for name in others:
        if errors[name] < (1 - MARGIN) * errors[winner]:
            winner = name
    return winner
