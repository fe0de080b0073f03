"""There and back through a velocity field: what each solver loses, on a real prior."""

from __future__ import annotations

import time
from collections.abc import Callable

import torch
from torch import Tensor

from ahoy_core.prior.conditioning import Context
from ahoy_core.prior.evaluate import Clips, context_of
from ahoy_core.prior.solvers import Solver, sigma_grid, solve, steps_for
from ahoy_core.prior.video import VideoModel


@torch.no_grad()
def round_trips(
    video: VideoModel,
    clips: Clips,
    evaluations: tuple[int, ...],
    solvers: tuple[Solver, ...],
    reference_steps: int = 64,
) -> list[dict[str, float | str]]:
    """There and back through one field, and through two, for each solver and budget.

    Returns:
        Rows: solver, evaluations, round_trip and z1_error (root mean squares of normalized latents; z1 against RK4),
        cross_field (back under the body and front, the case that is used: distance to the reference's result), seconds.
    """
    held = torch.zeros(*clips.part.shape[:2], clips.part.shape[2] // 16, clips.part.shape[3] // 16, dtype=torch.bool)
    full = context_of(video, clips, held, coarse=False)
    neutral = full.neutral(video.embed([""]).expand(len(clips), -1, -1))
    clean = full.known
    assert clean is not None

    def field(context: Context) -> Callable[[Tensor, float], Tensor]:
        return lambda z, tau: video.velocity(z, tau, context)

    context = Context(full.text)
    exact = solve(field(context), clean, sigma_grid(0, 1, reference_steps), "rk4").state
    crossed = solve(field(neutral), exact, sigma_grid(1, 0, reference_steps), "rk4").state
    rows: list[dict[str, float | str]] = []
    for solver in solvers:
        for budget in evaluations:
            steps, start = steps_for(solver, budget), time.process_time()
            there = solve(field(context), clean, sigma_grid(0, 1, steps), solver)
            back = solve(field(context), there.state, sigma_grid(1, 0, steps), solver, partner=there.partner)
            seconds = time.process_time() - start
            other = solve(field(neutral), there.state, sigma_grid(1, 0, steps), solver)
            rows.append(
                {
                    "solver": solver,
                    "evaluations": budget,
                    "round_trip": _rms(back.state - clean),
                    "z1_error": _rms(there.state - exact),
                    "cross_field": _rms(other.state - crossed),
                    "cpu_seconds": seconds,
                }
            )
    return rows


def _rms(values: Tensor) -> float:
    return float(values.square().mean().sqrt())
