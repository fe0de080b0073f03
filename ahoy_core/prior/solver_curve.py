"""What a solver's accuracy costs and buys: RF-inversion on held-out clips, a row for each solver and budget."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from ahoy_core.metrics.perceptual import Perceptual
from ahoy_core.prior.clips import Clips
from ahoy_core.prior.conditioning import Context
from ahoy_core.prior.config import InversionConfig
from ahoy_core.prior.evaluate import Repair, inverted, repaired
from ahoy_core.prior.inversion import Hallucination
from ahoy_core.prior.solvers import Solver, SolverError, steps_for
from ahoy_core.prior.video import VideoModel


@dataclass
class Billed:
    """A repair that remembers what its last use took: CPU seconds, and evaluations of the field."""

    repair: Repair
    seconds: float = 0.0
    evaluations: int = 0

    def __call__(self, coarse: Tensor, context: Context) -> Hallucination:
        """The repair."""
        start = time.process_time()
        made = self.repair(coarse, context)
        self.seconds, self.evaluations = time.process_time() - start, made.evaluations
        return made


def solver_curve(
    video: VideoModel,
    clips: Clips,
    evaluations: tuple[int, ...],
    solvers: tuple[Solver, ...],
    base: InversionConfig | None = None,
    perceptual: Perceptual | None = None,
) -> list[dict[str, Any]]:
    """RF-inversion of coarse turns with each solver and budget.

    Args:
        video: the prior.
        clips: held-out clips, coarse pictures among them.
        evaluations: budgets, of the field each way.
        solvers: which.
        base: knobs other than solver and steps.
        perceptual: network.

    Returns:
        Rows: solver, evaluations (the budget), steps, evaluations_used (both ways together), cpu_seconds (a sequence,
        coding and decoding apart), and what `repaired` says of it: unobserved, observed, gradient, colours and
        perceptual; or failed, the solver's words, instead of figures.
    """
    base = base or InversionConfig()
    rows: list[dict[str, Any]] = []
    for solver in solvers:
        for budget in evaluations:
            steps = steps_for(solver, budget)
            config = base.model_copy(update={"solver": solver, "steps": steps})
            row: dict[str, Any] = {"solver": solver, "evaluations": budget, "steps": steps}
            method = Billed(inverted(video, config))
            try:
                figures = repaired(video, clips, {"made": method}, perceptual)
            except SolverError as problem:
                rows.append(row | {"failed": str(problem)})
                continue
            made = {name.removeprefix("made/"): value for name, value in figures.items() if name.startswith("made/")}
            spent = {"evaluations_used": method.evaluations, "cpu_seconds": method.seconds / len(clips)}
            rows.append(row | spent | made)
    return rows
