"""RF-inversion and clean-up: limits of the controllers, what is held, and the plain round trip as a numeric test."""

from __future__ import annotations

import pytest
import torch
from pydantic import ValidationError
from torch import Tensor

from ahoy_core.prior.conditioning import Context, held_latents
from ahoy_core.prior.config import IdentityConfig, InversionConfig
from ahoy_core.prior.evidence import Frames
from ahoy_core.prior.identity import train_identity
from ahoy_core.prior.inversion import clean_up, hallucinate, invert, regenerate
from ahoy_core.prior.solvers import Solver, SolverError, sigma_grid, solve
from ahoy_core.prior.video import VideoModel

SHAPE = (1, 16, 2, 4, 4)


def noise(seed: int) -> Tensor:
    return torch.randn(SHAPE, generator=torch.Generator().manual_seed(seed))


class Linear:
    """A field that is known: data is always `target`, so v(z, tau) = (z - target) / tau, finite at 0 by its limit."""

    def __init__(self, target: Tensor) -> None:
        self.target = target

    def velocity(self, latents: Tensor, tau: float, context: Context) -> Tensor:
        return (latents - self.target) / max(tau, 1e-3)


@pytest.mark.parametrize("solver", ["euler", "midpoint", "heun", "rk4"])
def test_gamma_one_arrives_at_the_drawn_noise(solver: Solver) -> None:
    config = InversionConfig(solver=solver, tau_max=1.0, gamma=1.0, steps=6)
    there = invert(Linear(noise(0)), noise(1), Context(torch.zeros(1, 0, 0)), config, noise(2))
    if solver in ("euler", "midpoint"):
        torch.testing.assert_close(there.latents, noise(2), rtol=0, atol=1e-5)
    assert bool(torch.isfinite(there.latents).all())
    assert float((there.latents - noise(2)).abs().max()) < 0.5 * float((noise(1) - noise(2)).abs().max())


@pytest.mark.parametrize("solver", ["euler", "midpoint"])
def test_eta_one_over_the_whole_way_arrives_at_the_reference(solver: Solver) -> None:
    config = InversionConfig(solver=solver, tau_max=1.0, gamma=1.0, eta=1.0, eta_start=0.0, eta_stop=1.0, steps=6)
    back = regenerate(Linear(noise(0)), noise(1), noise(2), Context(torch.zeros(1, 0, 0)), config)
    torch.testing.assert_close(back.latents, noise(2), rtol=0, atol=1e-5)


def test_one_step_of_clean_up_is_the_posterior_mean() -> None:
    cleaned = clean_up(Linear(noise(0)), noise(1), Context(torch.zeros(1, 0, 0)), steps=1)
    assert cleaned.evaluations == 1
    torch.testing.assert_close(cleaned.latents, noise(0), rtol=0, atol=1e-6)


@torch.no_grad()
def test_held_latents_come_out_as_they_went_in(embedded: VideoModel) -> None:
    held = torch.zeros(1, 2, 2, 2, dtype=torch.bool)
    held[0, 0] = True
    context = Context(embedded.embed(["a person"]), known=noise(5), held=held)
    inside = held_latents(held).expand(SHAPE)
    neutral = embedded.embed([""])
    result = hallucinate(
        embedded, noise(6), context, neutral, InversionConfig(steps=2), torch.Generator().manual_seed(0)
    )
    assert torch.equal(result.latents[inside], noise(5)[inside])
    assert not torch.allclose(result.latents[~inside], noise(6)[~inside])
    assert torch.equal(clean_up(embedded, noise(7), context, steps=2).latents[inside], noise(5)[inside])


@torch.no_grad()
def test_the_round_trip_through_one_field_comes_back(embedded: VideoModel) -> None:
    """The paper's equation 4 with one field is the identity up to solver error, which falls with the steps."""
    context = Context(embedded.embed(["a person"]))
    errors = []
    for steps in (4, 16):
        config = InversionConfig(mode="paper", tau_max=1.0, gamma=0.0, steps=steps)
        result = hallucinate(embedded, noise(1), context, context.text, config, torch.Generator().manual_seed(0))
        errors.append(float((result.latents - noise(1)).square().mean().sqrt()))
    # Second order would be 16 times less; the clock's embedding (1000 tau) is rough at four steps, so less is asked.
    assert errors[1] < errors[0] / 4 and errors[1] < 2e-3, errors


@torch.no_grad()
def test_reversible_heun_comes_back_through_the_network(embedded: VideoModel) -> None:
    context = Context(embedded.embed(["a person"]))

    def field(z: Tensor, tau: float) -> Tensor:
        return embedded.velocity(z, tau, context)

    there = solve(field, noise(1), sigma_grid(0, 1, 16), "reversible_heun")
    back = solve(field, there.state, sigma_grid(1, 0, 16), "reversible_heun", partner=there.partner)
    assert float((back.state - noise(1)).square().mean().sqrt()) < 1e-5


def test_the_way_there_is_neutral_and_the_way_back_is_the_subjects(embedded: VideoModel) -> None:
    """Steered: the adapter changes the result only through the way back; paper: through both."""
    visible = torch.ones(1, 1, 32, 32)
    with torch.no_grad():
        plain = Context(embedded.embed(["a person"]))
        config = InversionConfig(steps=2, gamma=0.0)
        before = invert(embedded, noise(1), plain.neutral(plain.text), config, noise(2)).latents
    train_identity(embedded, Frames(torch.rand(1, 3, 32, 32), visible), IdentityConfig(rank=4, steps=12, batch=2))
    calls = []
    original = embedded.velocity

    def watched(latents: Tensor, tau: float, context: Context) -> Tensor:
        velocity = original(latents, tau, context)
        calls.append((latents.clone(), tau))
        return velocity

    embedded.velocity = watched  # type: ignore[method-assign]
    with torch.no_grad():
        hallucinate(embedded, noise(1), plain, plain.text, config, torch.Generator().manual_seed(0))
    embedded.velocity = original  # type: ignore[method-assign]
    turning = next(k for k in range(1, len(calls)) if calls[k][1] == config.tau_max)
    torch.testing.assert_close(calls[turning][0], before, rtol=0, atol=1e-6)


@torch.no_grad()
def test_a_nan_from_the_model_is_an_error_with_its_cause(embedded: VideoModel) -> None:
    next(embedded.components.transformer.parameters()).fill_(float("nan"))
    context = Context(embedded.embed(["a person"]))
    with pytest.raises(SolverError, match=r"not \(nan\) in fireflow step 0 at tau 0.*the model made it"):
        hallucinate(embedded, noise(1), context, context.text, InversionConfig(), torch.Generator().manual_seed(0))


@torch.no_grad()
def test_bfloat16_weights_with_a_float32_state(embedded: VideoModel) -> None:
    context = Context(embedded.embed(["a person"]))
    exact = clean_up(embedded, noise(1), context, steps=4).latents
    embedded.components.transformer.to(torch.bfloat16)
    rough = clean_up(embedded, noise(1), context, steps=4).latents
    assert rough.dtype == torch.float32
    # bfloat16 has 8 bits: relative error 0.4%, over four steps of a velocity of size about 1
    torch.testing.assert_close(rough, exact, rtol=0, atol=0.1)


@pytest.mark.parametrize(
    "knobs",
    [
        {"mode": "paper", "tau_max": 0.8},
        {"mode": "paper", "tau_max": 1.0, "gamma": 0.5},
        {"eta_start": 0.5, "eta_stop": 0.2},
        {"tau_max": 0.0},
        {"gamma": 1.5},
        {"steps": 0},
    ],
)
def test_knobs_that_make_no_sense_are_refused(knobs: dict[str, float]) -> None:
    with pytest.raises(ValidationError):
        InversionConfig(**knobs)
