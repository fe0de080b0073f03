"""Solvers of dz/dtau = v(z, tau) on an explicit grid of flow times, forwards or backwards, for batches.

Every step reads like its equation. The state is float32 (float64 if it comes so) whatever the field computes in; the
grid is a list of Python floats, so that tau = 0 and tau = 1 are met exactly and no time is rounded to an integer.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import torch
from torch import Tensor

Field = Callable[[Tensor, float], Tensor]
"""v(z, tau): state [B,...] and flow time -> velocity [B,...]."""
Solver = Literal["euler", "midpoint", "heun", "rk4", "fireflow", "reversible_heun"]

EVALUATIONS: Final[dict[Solver, int]] = {
    "euler": 1,
    "midpoint": 2,
    "heun": 2,
    "rk4": 4,
    "fireflow": 1,
    "reversible_heun": 1,
}
"""Function evaluations a step (FireFlow needs one more in all, reversible Heun one more at its start)."""
ORDERS: Final[dict[Solver, int]] = {
    "euler": 1,
    "midpoint": 2,
    "heun": 2,
    "rk4": 4,
    "fireflow": 2,
    "reversible_heun": 2,
}
"""Of the global error in the step size."""
GROWTH_LIMIT: Final = 10.0
"""Times the size of the starting state: if reversible Heun's two states differ by more, it has diverged.

For a smooth field they differ by the local error, far below the state itself, and latents on their way to noise keep
their size. On a stiff field the difference is multiplied every step (the method is only neutrally stable), so the limit
is passed soon after it matters.
"""


class SolverError(ArithmeticError):
    """A solution is of no use. The text says at which step and time, what was found, the likely cause, what to do."""


@dataclass(frozen=True)
class Solution:
    """Where a solver arrived.

    Attributes:
        state: [B,...].
        evaluations: of the field.
        partner: [B,...], reversible Heun's second state, with which `solve` goes back exactly; else None.
    """

    state: Tensor
    evaluations: int
    partner: Tensor | None = None


def sigma_grid(start: float, stop: float, steps: int, shift: float = 1.0) -> tuple[float, ...]:
    """Flow times from `start` to `stop`, both met exactly.

    Args:
        start: in [0,1].
        stop: in [0,1], above or below `start`.
        steps: at least 1.
        shift: 1 for even steps; above 1 for smaller ones near 0 and larger ones near 1 (as diffusers' schedulers do it,
            but once).

    Raises:
        ValueError: when an argument is out of its range.
    """
    if steps < 1 or min(start, stop) < 0 or max(start, stop) > 1 or not shift > 0:
        raise ValueError(
            f"expected times in [0,1], at least one step and a positive shift, got {start} to {stop} in {steps} steps, "
            f"shift {shift}"
        )

    def shifted(t: float) -> float:
        return shift * t / (1 + (shift - 1) * t)

    def even(t: float) -> float:
        return t / (shift - (shift - 1) * t)

    first, last = even(start), even(stop)
    inner = [shifted(first + (last - first) * k / steps) for k in range(1, steps)]
    return (start, *inner, stop)


def steps_for(solver: Solver, evaluations: int) -> int:
    """Steps that use at most so many function evaluations, at least one step."""
    extra = 1 if solver in ("fireflow", "reversible_heun") else 0
    return max(1, (evaluations - extra) // EVALUATIONS[solver])


def solve(
    field: Field, state: Tensor, grid: Sequence[float], solver: Solver = "midpoint", partner: Tensor | None = None
) -> Solution:
    """Integrates a field along a grid.

    Args:
        field: v(z, tau); may compute in any dtype.
        state: [B,...] at `grid[0]`.
        grid: flow times, monotone; from `sigma_grid`.
        solver: see `EVALUATIONS`.
        partner: of the solution that is to be undone; reversible Heun only.

    Raises:
        SolverError: when the field returns values that are not finite, or reversible Heun diverges.
        ValueError: for an unknown solver or a grid that is not monotone.
    """
    if solver not in EVALUATIONS:
        raise ValueError(f"expected a solver of {', '.join(EVALUATIONS)}, got {solver!r}")
    steps = list(itertools.pairwise(grid))
    if not (all(t > s for s, t in steps) or all(t < s for s, t in steps)):
        raise ValueError(f"expected strictly rising or falling flow times, got {list(grid)[:6]}...; use sigma_grid")
    guarded = _Guarded(field, state, solver)
    z = state if state.dtype == torch.float64 else state.float()
    if solver == "reversible_heun":
        return _reversible_heun(guarded, z, steps, partner)
    if solver == "fireflow":
        return Solution(_fireflow(guarded, z, steps), guarded.evaluations)
    step = {"euler": _euler, "midpoint": _midpoint, "heun": _heun, "rk4": _rk4}[solver]
    for number, (s, t) in enumerate(steps):
        guarded.step = number
        z = step(guarded, z, s, t)
    return Solution(z, guarded.evaluations)


class _Guarded:
    """A field in the state's precision, that counts its calls and refuses to go on with what is not finite."""

    def __init__(self, field: Field, state: Tensor, solver: Solver) -> None:
        self.field, self.solver = field, solver
        self.dtype = torch.float64 if state.dtype == torch.float64 else torch.float32
        self.step = self.evaluations = 0

    def __call__(self, z: Tensor, tau: float) -> Tensor:
        self.evaluations += 1
        velocity = self.field(z, tau).to(self.dtype)
        bad = int((~torch.isfinite(velocity)).sum())
        if bad:
            cause = (
                "the state was finite, so the model made it" if bool(torch.isfinite(z).all()) else "so was the state"
            )
            raise SolverError(
                f"expected finite velocities, got {bad} of {velocity.numel()} that are not ({_sample(velocity)}) in "
                f"{self.solver} step {self.step} at tau {tau:.4f}: {cause}; check the weights, or use float32"
            )
        return velocity


def _sample(values: Tensor) -> str:
    return str(float(values[~torch.isfinite(values)][0]))


def _euler(v: Field, z: Tensor, s: float, t: float) -> Tensor:
    return z + (t - s) * v(z, s)


def _midpoint(v: Field, z: Tensor, s: float, t: float) -> Tensor:
    h = t - s
    return z + h * v(z + h / 2 * v(z, s), s + h / 2)


def _heun(v: Field, z: Tensor, s: float, t: float) -> Tensor:
    h, first = t - s, v(z, s)
    return z + h / 2 * (first + v(z + h * first, t))


def _rk4(v: Field, z: Tensor, s: float, t: float) -> Tensor:
    h, middle = t - s, s + (t - s) / 2
    k1 = v(z, s)
    k2 = v(z + h / 2 * k1, middle)
    k3 = v(z + h / 2 * k2, middle)
    k4 = v(z + h * k3, t)
    return z + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def _fireflow(v: _Guarded, z: Tensor, steps: list[tuple[float, float]]) -> Tensor:
    """Midpoint steps whose first velocity is the last step's middle one (Deng et al., "FireFlow", 2024)."""
    velocity: Tensor | None = None
    for number, (s, t) in enumerate(steps):
        v.step, h = number, t - s
        velocity = v(z, s) if velocity is None else velocity
        velocity = v(z + h / 2 * velocity, s + h / 2)
        z = z + h * velocity
    return z


def _reversible_heun(v: _Guarded, z: Tensor, steps: list[tuple[float, float]], partner: Tensor | None) -> Solution:
    """Kidger et al., "Efficient and accurate gradients for neural SDEs" (2021): exactly undone by negative steps."""
    other = z if partner is None else partner.to(z)
    velocity = v(other, steps[0][0])
    size = max(float(z.norm()), math.sqrt(z.numel()))
    for number, (s, t) in enumerate(steps):
        v.step, h = number, t - s
        other = 2 * z - other + h * velocity
        following = v(other, t)
        z = z + h / 2 * (velocity + following)
        velocity = following
        apart = float((z - other).norm())
        if not apart <= GROWTH_LIMIT * size:
            raise SolverError(
                f"expected reversible Heun's two states to stay together, got a distance of {apart:.3g} against a size "
                f"of {size:.3g} in step {number} at tau {t:.4f}: the field is too stiff for this step; use more steps, "
                "or midpoint"
            )
    return Solution(z, v.evaluations, other)
