"""What the prior's accuracy costs: solvers over budgets, low-rank updates over steps; parts of `benchmarks.prior`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from ahoy_core.cost.sweep import Measurement, Spread
from ahoy_core.metrics.perceptual import Perceptual
from ahoy_core.prior.clips import Clips, load_clips
from ahoy_core.prior.config import IdentityConfig, InversionConfig
from ahoy_core.prior.corpus.shards import shards
from ahoy_core.prior.corpus.wardrobe import Split
from ahoy_core.prior.identity_curve import Subject, corpus_subjects, identity_curve, mean_rows
from ahoy_core.prior.round_trip import round_trips
from ahoy_core.prior.scores import NO_PERCEPTUAL
from ahoy_core.prior.solver_curve import solver_curve
from ahoy_core.prior.solvers import EVALUATIONS
from ahoy_core.prior.video import VideoModel
from tasks.cost.plots import draw

BUDGETS = (8, 16, 32, 64)
_REFERENCE_STEPS = 128  # of RK4: 512 evaluations, eight times the largest budget
RANKS = (2, 4, 8, 16)
STEPS = (20, 40, 80, 160)
_SPLITS: tuple[Split, ...] = ("people", "mesh")


def solvers(video: VideoModel, corpus: Path, clips: int, perceptual: Perceptual | None) -> dict[str, Any]:
    """Round trip, distance of z1 to a converged reference, and what RF-inversion's pictures are worth."""
    shown = {split: load_clips(shards(corpus, split)[0], clips, turning=False) for split in _SPLITS}
    few = load_clips(shards(corpus, "people")[0], 1).views([0, 2, 4, 6])
    names = tuple(EVALUATIONS)
    trips = round_trips(video, few, BUDGETS, names, _REFERENCE_STEPS)
    together = Clips(**{name: _joined(shown, name) for name in vars(next(iter(shown.values())))})
    return {
        "default": InversionConfig().model_dump(),
        "clips": len(together),
        "perceptual": NO_PERCEPTUAL if perceptual is None else perceptual.name,
        "reference": {"rk4_steps": trips.reference.steps, "change_on_doubling": trips.reference.change},
        "round_trip": trips.rows,
        "hallucination": solver_curve(video, together, BUDGETS, names, perceptual=perceptual),
    }


def _joined(shown: Mapping[Split, Clips], name: str) -> Any:
    return torch.cat([getattr(clips, name) for clips in shown.values()])


def identity(video: VideoModel, corpus: Path | None, captures: Sequence[Subject], people: int) -> dict[str, Any]:
    """Rank and steps on captures and on some people of each held-out split."""
    subjects = list(captures)
    for split in _SPLITS if corpus is not None else ():
        assert corpus is not None
        subjects += corpus_subjects(load_clips(shards(corpus, split)[0], people), split)
    rows = [row for subject in subjects for row in identity_curve(video, subject, RANKS, STEPS)]
    return {"default": IdentityConfig().model_dump(), "rows": rows, "mean": mean_rows(rows)}


def draw_curves(found: Mapping[str, Any], folder: Path) -> list[Path]:
    """The diagrams of what was measured, errors over CPU seconds; a line a solver or rank.

    Args:
        found: the benchmark's object.
        folder: for the PNGs; exists.
    """
    wanted = []
    if "solvers" in found:
        trips, made = found["solvers"]["round_trip"], found["solvers"]["hallucination"]
        wanted += [
            ("prior-round-trip.png", _measured(trips, "solver", "evaluations"), "round_trip", "RMS of latents"),
            ("prior-z1.png", _measured(trips, "solver", "evaluations"), "z1_error", "RMS of latents"),
            ("prior-final.png", _measured(made, "solver", "evaluations"), "error_unobserved", "RMS colour error"),
        ]
    if "identity" in found:
        rows = [row for row in found["identity"]["mean"] if row["rank"] > 0]
        wanted.append(("prior-identity.png", _measured(rows, "rank", "steps"), "colour_distance", "of sqrt 3"))
    return [folder / name for name, rows, error, unit in wanted if draw(rows, error, unit, folder / name)]


def _measured(rows: Sequence[Mapping[str, Any]], line: str, knob: str) -> list[Measurement]:
    """Rows as the diagrams take them: every figure an error, PSNRs as root mean squares."""
    made = []
    for row in rows:
        name = f"prior.{row[line]}" if line == "solver" else f"prior.{line} {row[line]}"
        if "failed" in row:
            made.append(Measurement(name, {knob: row[knob]}, failed=row["failed"]))
            continue
        errors = {key: row[key] for key in ("round_trip", "z1_error") if key in row}
        if "unobserved" in row:
            errors["error_unobserved"] = 10 ** (-row["unobserved"] / 20)
        distances = [value for key, value in row.items() if key.startswith("colour_distance/")]
        if distances:
            errors["colour_distance"] = sum(distances) / len(distances)
        seconds = Spread.of([row["cpu_seconds"]])
        made.append(Measurement(name, {knob: row[knob]}, errors, cpu_s=seconds))
    return made
