"""How much work a stage has at given knobs, and a model of its seconds fitted to measured rows.

A stage's CPU seconds are a sum of terms, each a rate times a count that the knobs decide (frames looked at, map pixels
times steps, ...). The rates are fitted to what was measured and never negative; so a prediction between measured
settings is sound, and one far outside them is a guess that grows as the work does.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import nnls

Knobs = Mapping[str, Any]
"""`stage.knob` -> value; `clip.frames` and `clip.pixels` (of a frame) say what the stages are given."""

FRAMES, PIXELS = "clip.frames", "clip.pixels"
_PIXELS = 256 * 256


def _ingest(k: Knobs) -> dict[str, float]:
    return {"pixels": k[FRAMES] * k[PIXELS] / _PIXELS, "once": 1.0}


def _perceive(k: Knobs) -> dict[str, float]:
    frames = -(-k[FRAMES] // k["perceive.stride"])
    return {
        "frames": frames,
        "readings": frames * k["perceive.passes"],
        "fit": frames * k["perceive.iterations"],
        "outline": frames * (k["perceive.outline"] > 0),
        "corrector": frames * bool(k["perceive.corrector"]),
        "refinement": frames * bool(k["perceive.mask_refinement"]) * k[PIXELS] / _PIXELS,
        "pixels": k[FRAMES] * k[PIXELS] / _PIXELS,
        "once": 1.0,
    }


def _texture(k: Knobs) -> dict[str, float]:
    looks = -(-k[FRAMES] // k["texture.frame_stride"]) * (2 if k["texture.rule"] == "median" else 1)
    texels = (k["texture.atlas_size"] / 256) ** 2
    rays = k["texture.canonical_height"] * k["texture.canonical_width"] * k["texture.supersample"] ** 2 / 200_000
    return {
        "pixels": looks * k[PIXELS] / _PIXELS,
        "texels": texels,
        "texel looks": looks * texels,
        "views": rays,
        "once": 1.0,
    }


def _complete(k: Knobs) -> dict[str, float]:
    return {"texels": (k["texture.atlas_size"] / 256) ** 2, "once": 1.0}


def _coarse(k: Knobs) -> dict[str, float]:
    steps, maps = k["coarse.steps"], (k["coarse.map_size"] / 128) ** 2
    return {
        "network": steps * maps * k["coarse.width"] / 16,
        "gaussians": steps * maps,
        "shots": steps * k["coarse.frames_per_step"],
        "steps": steps,
        "maps": maps,
        "once": 1.0,
    }


def _avatar(k: Knobs) -> dict[str, float]:
    steps, maps = k["avatar.steps"], (k["coarse.map_size"] / 128) ** 2
    sequences, shots = k["avatar.sequences_per_step"], k["avatar.shots_per_sequence"]
    posed = maps * (2 / k["avatar.map_reduction"]) ** 2 * k["avatar.width"] / 16
    return {
        "network": steps * (sequences + 1) * posed,
        "gaussians": steps * (sequences * shots + k["avatar.frames_per_step"] + k["avatar.faces_per_step"]) * maps,
        "steps": steps,
        "maps": maps,
        "once": 1.0,
    }


def _animate(k: Knobs) -> dict[str, float]:
    pictures = k["animate.turntable_frames"] + k["animate.motion_frames"]
    return {
        "pixels": pictures * k["animate.height"] * k["animate.width"] / 49_152,
        "gaussians": pictures * (k["coarse.map_size"] / 128) ** 2,
        "once": 1.0,
    }


WORK: Mapping[str, Callable[[Knobs], dict[str, float]]] = {
    "ingest": _ingest,
    "perceive": _perceive,
    "texture": _texture,
    "complete": _complete,
    "coarse": _coarse,
    "avatar": _avatar,
    "animate": _animate,
    "report": lambda k: {"once": 1.0},
}
"""Terms of each stage; those that run only where the prior wins its self-check are not here."""

KNOBS: tuple[str, ...] = (
    *(FRAMES, PIXELS),
    *(f"perceive.{name}" for name in ("passes", "iterations", "stride", "outline", "corrector", "mask_refinement")),
    *(f"texture.{name}" for name in ("atlas_size", "frame_stride", "rule", "supersample")),
    *("texture.canonical_height", "texture.canonical_width"),
    *(f"coarse.{name}" for name in ("map_size", "steps", "width", "frames_per_step")),
    *(f"avatar.{name}" for name in ("steps", "map_reduction", "width", "sequences_per_step", "shots_per_sequence")),
    *("avatar.frames_per_step", "avatar.faces_per_step"),
    *(f"animate.{name}" for name in ("height", "width", "turntable_frames", "motion_frames")),
)
"""Everything that the terms read."""


@dataclass(frozen=True)
class TimeModel:
    """Seconds of each stage.

    Attributes:
        rates: stage -> term -> CPU seconds of one unit.
        error: stage -> median relative difference from the rows that it was fitted to.
    """

    rates: Mapping[str, Mapping[str, float]]
    error: Mapping[str, float]

    def seconds(self, stage: str, knobs: Knobs) -> float | None:
        """CPU seconds on the machine of the rows; None for a stage that was never measured."""
        if stage not in self.rates:
            return None
        return sum(self.rates[stage][term] * count for term, count in WORK[stage](knobs).items())

    def all_seconds(self, knobs: Knobs) -> dict[str, float]:
        """CPU seconds of every stage that was measured."""
        return {stage: float(self.seconds(stage, knobs) or 0.0) for stage in self.rates}


def fit_times(rows: Iterable[tuple[str, Knobs, float]]) -> TimeModel:
    """Fit the rates by least squares of relative differences.

    Args:
        rows: stage, knobs and measured CPU seconds.
    """
    by_stage: dict[str, list[tuple[Sequence[float], float]]] = {}
    for stage, knobs, seconds in rows:
        if stage in WORK and seconds > 0:
            by_stage.setdefault(stage, []).append((list(WORK[stage](knobs).values()), seconds))
    rates, error = {}, {}
    for stage, pairs in by_stage.items():
        counts, took = np.array([row for row, _ in pairs], dtype=np.float64), np.array([one for _, one in pairs])
        found, _ = nnls(counts / took[:, None], np.ones(len(took)))
        names = list(WORK[stage](_any()))
        rates[stage] = dict(zip(names, map(float, found), strict=True))
        error[stage] = float(np.median(np.abs(counts @ found / took - 1)))
    return TimeModel(rates, error)


def _any() -> Knobs:
    """Knobs for which a stage's terms can be named."""
    return {name: "first" if name == "texture.rule" else 1 for name in KNOBS}
