"""Solvers against closed forms: order, reversal, ends of the flow, faults."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from ahoy_core.prior.solvers import (
    EVALUATIONS,
    ORDERS,
    Field,
    Solver,
    SolverError,
    sigma_grid,
    solve,
    steps_for,
)

SOLVERS: list[Solver] = list(EVALUATIONS)


def rotating(z: Tensor, tau: float) -> Tensor:
    """z' = a(tau) J z with a growing angle: z(tau) = R(tau + tau^2) z(0); nonlinear in time, known exactly."""
    return (1 + 2 * tau) * torch.stack([-z[..., 1], z[..., 0]], -1)


def rotated(z: Tensor, tau: float) -> Tensor:
    angle = tau + tau * tau
    c, s = math.cos(angle), math.sin(angle)
    return torch.stack([c * z[..., 0] - s * z[..., 1], s * z[..., 0] + c * z[..., 1]], -1)


def logistic(z: Tensor, tau: float) -> Tensor:
    """z' = z (1 - z): nonlinear in the state."""
    return z * (1 - z)


def grown(z: Tensor, tau: float) -> Tensor:
    return z * math.exp(tau) / (1 - z + z * math.exp(tau))


FIELDS = {
    "rotating": (rotating, rotated, torch.tensor([[1.0, 0.5], [-0.3, 2.0]], dtype=torch.float64)),
    "logistic": (logistic, grown, torch.tensor([[0.1], [0.6]], dtype=torch.float64)),
}


@pytest.mark.parametrize("name", FIELDS)
@pytest.mark.parametrize("solver", SOLVERS)
def test_error_falls_with_the_order_of_the_solver(solver: Solver, name: str) -> None:
    field, exact, start = FIELDS[name]
    steps = np.array([16, 24, 32, 48, 64])
    errors = [
        float((solve(field, start, sigma_grid(0, 1, int(n)), solver).state - exact(start, 1.0)).norm()) for n in steps
    ]
    slope = -np.polyfit(np.log(steps), np.log(errors), 1)[0]
    # Next-order terms bend the line a little at 16 steps; a neighbouring order would be off by 1.
    assert slope == pytest.approx(ORDERS[solver], abs=0.25), errors


@pytest.mark.parametrize("solver", SOLVERS)
def test_backwards_in_time_has_the_same_order(solver: Solver) -> None:
    start = FIELDS["rotating"][2]
    steps = np.array([16, 32, 64])
    errors = [
        float((solve(rotating, rotated(start, 1.0), sigma_grid(1, 0, int(n)), solver).state - start).norm())
        for n in steps
    ]
    assert -np.polyfit(np.log(steps), np.log(errors), 1)[0] == pytest.approx(ORDERS[solver], abs=0.25)


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_constant_field_is_exact_in_one_step(solver: Solver) -> None:
    start = torch.tensor([[1.0, -2.0]])
    solution = solve(lambda z, _: torch.full_like(z, 3.0), start, (0.0, 1.0), solver)
    torch.testing.assert_close(solution.state, start + 3, rtol=0, atol=1e-6)


@pytest.mark.parametrize("solver", SOLVERS)
def test_evaluations_are_what_the_table_says_and_fit_the_budget(solver: Solver) -> None:
    calls = []
    solution = solve(lambda z, t: calls.append(t) or z, torch.ones(1, 2), sigma_grid(0, 1, 5), solver)
    extra = 1 if solver in ("fireflow", "reversible_heun") else 0
    assert solution.evaluations == len(calls) == 5 * EVALUATIONS[solver] + extra
    assert min(calls) >= 0 and max(calls) <= 1
    budget = steps_for(solver, 9)
    assert budget * EVALUATIONS[solver] + extra <= 9 < (budget + 1) * EVALUATIONS[solver] + extra


def test_one_evaluation_is_one_euler_step() -> None:
    assert steps_for("euler", 1) == steps_for("rk4", 1) == 1
    solution = solve(lambda z, t: z * 0 + t, torch.zeros(1, 2), (1.0, 0.0), "euler")
    torch.testing.assert_close(solution.state, torch.full((1, 2), -1.0), rtol=0, atol=0)


@pytest.mark.parametrize("shift", [1.0, 3.0])
def test_the_grid_meets_both_ends_exactly_and_reverses(shift: float) -> None:
    up, down = sigma_grid(0.0, 1.0, 7, shift), sigma_grid(1.0, 0.0, 7, shift)
    assert up[0] == 0.0 and up[-1] == 1.0 and len(up) == 8
    assert up == pytest.approx(down[::-1], abs=1e-15)
    assert sigma_grid(0.3, 0.9, 1, shift) == (0.3, 0.9)


def test_the_shift_is_applied_once() -> None:
    # 3 t / (1 + 2 t) at t = 1/2
    assert sigma_grid(0, 1, 2, 3.0)[1] == pytest.approx(0.75)


def test_reversible_heun_undoes_itself_and_the_others_do_not() -> None:
    generator = torch.Generator().manual_seed(0)
    start = torch.randn(64, 2, generator=generator)
    there = solve(rotating, start, sigma_grid(0, 1, 8), "reversible_heun")
    back = solve(rotating, there.state, sigma_grid(1, 0, 8), "reversible_heun", partner=there.partner)
    # float32 rounding over 16 steps
    assert float((back.state - start).square().mean().sqrt()) < 1e-6
    assert back.partner is not None and float((back.partner - start).abs().max()) < 1e-5
    forgotten = solve(rotating, there.state, sigma_grid(1, 0, 8), "reversible_heun")
    assert float((forgotten.state - start).abs().max()) > 1e-3
    other = solve(rotating, solve(rotating, start, sigma_grid(0, 1, 8), "heun").state, sigma_grid(1, 0, 8), "heun")
    assert float((other.state - start).abs().max()) > 1e-3


def test_reversible_heun_on_a_stiff_field_is_reported() -> None:
    def pulled(strength: float) -> Field:
        return lambda z, tau: -strength * (z - math.cos(tau))

    with pytest.raises(SolverError, match=r"two states .* step \d+ at tau .* use more steps, or midpoint"):
        solve(pulled(80), torch.zeros(4, 2), sigma_grid(0, 1, 40), "reversible_heun")
    # Midpoint is stable there once its steps are short enough, and so is reversible Heun on a gentle pull.
    assert float((solve(pulled(80), torch.zeros(4, 2), sigma_grid(0, 1, 80)).state - math.cos(1)).abs().max()) < 0.05
    gentle = solve(pulled(2), torch.ones(4, 2), sigma_grid(0, 1, 40), "reversible_heun")
    exact = solve(pulled(2), torch.ones(4, 2, dtype=torch.float64), sigma_grid(0, 1, 400), "rk4").state
    torch.testing.assert_close(gentle.state.double(), exact, rtol=0, atol=2e-3)


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_nan_names_step_time_and_cause(solver: Solver) -> None:
    def broken(z: Tensor, tau: float) -> Tensor:
        return z * float("nan") if tau > 0.45 else z

    with pytest.raises(SolverError, match=r"nan.* step \d at tau 0\.[45]\d+.*the model made it"):
        solve(broken, torch.ones(1, 2), sigma_grid(0, 1, 10), solver)


def test_the_state_stays_float32_whatever_the_model_computes_in() -> None:
    def half(z: Tensor, tau: float) -> Tensor:
        return torch.full_like(z, 1e-3).bfloat16()

    start = torch.ones(1, 2).bfloat16()
    solution = solve(half, start, sigma_grid(0, 1, 200), "euler")
    assert solution.state.dtype == torch.float32
    # A bfloat16 state would not move at all: its spacing at 1 is 0.0078.
    assert float(solution.state[0, 0]) == pytest.approx(1.001, abs=1e-5)


def test_clips_of_a_batch_do_not_touch_each_other() -> None:
    start = torch.randn(3, 2, generator=torch.Generator().manual_seed(1))
    together = solve(rotating, start, sigma_grid(0, 1, 4), "rk4").state
    alone = torch.cat([solve(rotating, row[None], sigma_grid(0, 1, 4), "rk4").state for row in start])
    torch.testing.assert_close(together, alone, rtol=0, atol=0)


@pytest.mark.parametrize("grid", [(0.0, 0.0), (0.0, 0.5, 0.4)])
def test_a_grid_that_is_not_monotone_is_refused(grid: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="strictly rising or falling"):
        solve(rotating, torch.ones(1, 2), grid, "euler")


@pytest.mark.parametrize("arguments", [(0, 1, 0), (-0.1, 1, 4), (0, 1.1, 4)])
def test_a_grid_outside_the_flow_is_refused(arguments: tuple[float, float, int]) -> None:
    with pytest.raises(ValueError, match=r"times in \[0,1\]"):
        sigma_grid(*arguments)
