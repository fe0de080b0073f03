"""There and back through a velocity field: what each solver loses, on a real prior."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ahoy_core.prior.clips import Clips, context_of
from ahoy_core.prior.conditioning import Context
from ahoy_core.prior.solvers import Field, Solver, SolverError, sigma_grid, solve, steps_for
from ahoy_core.prior.video import VideoModel


@dataclass(frozen=True)
class Reference:
    """Where clean latents go, as exactly as is affordable.

    Attributes:
        noise: [B,C,T,h,w] at tau 1 of the field without conditions.
        crossed: [B,C,T,h,w] back at tau 0 through the field that knows the body.
        steps: of RK4, each way.
        change: root mean square by which `noise` changed when the steps doubled to `steps`: errors well above it are
            the solvers' own.
    """

    noise: Tensor
    crossed: Tensor
    steps: int
    change: float


@dataclass(frozen=True)
class RoundTrips:
    """Rows of `round_trips` and the reference that they are measured against."""

    rows: list[dict[str, Any]]
    reference: Reference


@torch.no_grad()
def round_trips(
    video: VideoModel,
    clips: Clips,
    evaluations: tuple[int, ...],
    solvers: tuple[Solver, ...],
    reference_steps: int = 64,
) -> RoundTrips:
    """There and back through one field, and through two, for each solver and budget.

    Returns:
        Rows: solver, evaluations (the budget each way), evaluations_used (of the field, each way), round_trip and
        z1_error (root mean squares of normalized latents; z1 against the reference), cross_field (back under the body,
        the case that is used: distance to the reference's result), cpu_seconds of the round trip; or failed, the
        solver's words, instead of errors.
    """
    clean, field, steered = _fields(video, clips)
    exact = _reference(clean, field, steered, reference_steps)
    rows: list[dict[str, Any]] = []
    for solver in solvers:
        for budget in evaluations:
            row: dict[str, Any] = {"solver": solver, "evaluations": budget}
            try:
                row |= _round_trip(clean, field, steered, exact, solver, steps_for(solver, budget))
            except SolverError as problem:
                row["failed"] = str(problem)
            rows.append(row)
    return RoundTrips(rows, exact)


def _fields(video: VideoModel, clips: Clips) -> tuple[Tensor, Field, Field]:
    """Clean latents, the field without conditions, and the one that knows the body."""
    held = torch.zeros(*clips.part.shape[:2], clips.part.shape[2] // 16, clips.part.shape[3] // 16, dtype=torch.bool)
    full = context_of(video, clips, held, coarse=False)
    neutral = full.neutral(video.embed([""]).expand(len(clips), -1, -1))
    assert full.known is not None

    def field(context: Context) -> Callable[[Tensor, float], Tensor]:
        return lambda z, tau: video.velocity(z, tau, context)

    return full.known, field(Context(full.text)), field(neutral)


def _reference(clean: Tensor, field: Field, steered: Field, steps: int) -> Reference:
    half = solve(field, clean, sigma_grid(0, 1, max(1, steps // 2)), "rk4").state
    noise = solve(field, clean, sigma_grid(0, 1, steps), "rk4").state
    crossed = solve(steered, noise, sigma_grid(1, 0, steps), "rk4").state
    return Reference(noise, crossed, steps, _rms(noise - half))


def _round_trip(
    clean: Tensor, field: Field, steered: Field, exact: Reference, solver: Solver, steps: int
) -> dict[str, float]:
    start = time.process_time()
    there = solve(field, clean, sigma_grid(0, 1, steps), solver)
    back = solve(field, there.state, sigma_grid(1, 0, steps), solver, partner=there.partner)
    seconds = time.process_time() - start
    other = solve(steered, there.state, sigma_grid(1, 0, steps), solver)
    return {
        "evaluations_used": there.evaluations,
        "round_trip": _rms(back.state - clean),
        "z1_error": _rms(there.state - exact.noise),
        "cross_field": _rms(other.state - exact.crossed),
        "cpu_seconds": seconds,
    }


def _rms(values: Tensor) -> float:
    return float(values.square().mean().sqrt())
