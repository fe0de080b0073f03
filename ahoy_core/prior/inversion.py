"""From coarse videos to hallucinated ones: RF-inversion (paper, equation 4) and the conditioned clean-up beside it."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import torch
from torch import Tensor

from ahoy_core.prior.conditioning import Context, hold
from ahoy_core.prior.config import InversionConfig
from ahoy_core.prior.identity import without_identity
from ahoy_core.prior.solvers import Solver, sigma_grid, solve
from ahoy_core.prior.video import VideoModel


@dataclass(frozen=True)
class Hallucination:
    """Latents [B,C,T,h,w] of a hallucinated video, and the function evaluations they took."""

    latents: Tensor
    evaluations: int


def invert(
    video: VideoModel, latents: Tensor, context: Context, config: InversionConfig, noise: Tensor
) -> Hallucination:
    """The forward pass: latents at tau 0 -> state at `tau_max`.

    The controller of RF-Inversion (Rout et al., 2024) mixes the field with the straight way to a drawn noise:
    v = (1 - gamma) v(z, tau) + gamma (noise - z) / (1 - tau).
    """
    grid = sigma_grid(0.0, config.tau_max, config.steps)
    floor = _floor(grid)

    def field(z: Tensor, tau: float) -> Tensor:
        if config.gamma == 1:
            return (noise - z) / max(1 - tau, floor)
        velocity = video.velocity(z, tau, context)
        if config.gamma == 0:
            return velocity
        return torch.lerp(velocity, (noise - z) / max(1 - tau, floor), config.gamma)

    solution = solve(field, latents, grid, config.solver)
    return Hallucination(solution.state, solution.evaluations)


def regenerate(
    video: VideoModel, state: Tensor, reference: Tensor, context: Context, config: InversionConfig
) -> Hallucination:
    """The way back: state at `tau_max` -> latents at tau 0, held ones as they were.

    Within the window of eta the controller mixes in the straight way to the reference:
    v = (1 - eta) v(z, tau) + eta (z - reference) / tau.
    """
    grid = sigma_grid(config.tau_max, 0.0, config.steps)
    floor = _floor(grid)

    def field(z: Tensor, tau: float) -> Tensor:
        velocity = video.velocity(z, tau, context)
        share = 1 - tau / config.tau_max
        if config.eta == 0 or not config.eta_start <= share <= config.eta_stop:
            return velocity
        return torch.lerp(velocity, (z - reference) / max(tau, floor), config.eta)

    solution = solve(field, hold(state, context), grid, config.solver)
    return Hallucination(hold(solution.state, context), solution.evaluations)


def hallucinate(
    video: VideoModel,
    coarse: Tensor,
    context: Context,
    neutral_text: Tensor,
    config: InversionConfig,
    generator: torch.Generator,
) -> Hallucination:
    """A coarse video through the prior's latent space and back (paper, section 3.2, "Hallucination via RF-Inversion").

    Args:
        video: the prior, with or without an identity adapter.
        coarse: [B,C,T,h,w] latents of the coarse rendering.
        context: of the way back: the subject's prompt, what is held, body.
        neutral_text: [B,S,D] embedding of a prompt that names nobody.
        config: knobs.
        generator: of the noise that gamma pulls towards.

    Raises:
        SolverError: when the model returns values that are not finite.
    """
    noise = torch.randn(coarse.shape, generator=generator)
    if config.mode == "paper":
        free = context.neutral(context.text)
        there = invert(video, coarse, free, config, noise)
        back = regenerate(video, there.latents, coarse, free, config)
    else:
        with without_identity(video):
            there = invert(video, coarse, context.neutral(neutral_text), config, noise)
        back = regenerate(video, there.latents, coarse, context, config)
    return Hallucination(back.latents, there.evaluations + back.evaluations)


def clean_up(
    video: VideoModel,
    noise: Tensor,
    context: Context,
    steps: int = 1,
    solver: Solver = "euler",
    shift: float = 2.0,
) -> Hallucination:
    """From noise to latents, led by the context (coarse latents, body, held frames); one step is the posterior mean.

    Args:
        video: the prior.
        noise: [B,C,T,h,w].
        context: what is known.
        steps: 1 gives the mean of what is plausible (blurry where much is), more give a sample.
        solver: see `solvers`.
        shift: of the grid.
    """
    solution = solve(
        lambda z, tau: video.velocity(z, tau, context), hold(noise, context), sigma_grid(1.0, 0.0, steps, shift), solver
    )
    return Hallucination(hold(solution.state, context), solution.evaluations)


def _floor(grid: tuple[float, ...]) -> float:
    """Half of the shortest step: the controllers divide by what is left of the way, which is 0 at its end.

    There their limit is "arrive within the step"; with half a step a two-stage solver does just that, and Euler,
    which never looks at the end, is untouched.
    """
    return 0.5 * min(abs(t - s) for s, t in itertools.pairwise(grid))
