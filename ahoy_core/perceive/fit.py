"""The body fitted to landmarks over the whole clip: one shape, a pose per frame (paper section 3.1; NLF there)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ahoy_core.body.model import BodyModel
from ahoy_core.body.rotations import matrix_to_axis_angle
from ahoy_core.perceive.edges import find_edges, make_skin
from ahoy_core.perceive.lift import root_rotations, translations
from ahoy_core.perceive.normal import solve
from ahoy_core.perceive.objective import FitConfig, Objective, assemble, costs, pose_weights
from ahoy_core.perceive.priors import build_prior
from ahoy_core.perceive.reduced import ReducedBody, reduce_body, reshape
from ahoy_core.perceive.residuals import MIN_DEPTH, Observations, differences, image_offsets, person_depth
from ahoy_core.perceive.state import State, linearise

SCALES = (0.5, 0.25, 0.1)  # metres: widths of Geman-McClure on the image, one after the other
OUTLINE_ROUNDS = 2  # edges are looked for anew in each
OUTLINE_STEPS = 6  # most in each: the start is close, and the edges move on anyway
FIRST_DAMPING = 1e-2
MAX_DAMPING = 1e6  # a step this damped does not move: the cost is as low as it gets
ENOUGH = 1e-4  # share of the cost below which a step's gain ends a stage
AGREEMENT = 0.08  # metres of image error at which confidence in a landmark has dropped to 1/e


@dataclass(frozen=True)
class Fit:
    """The body in the N fitted frames.

    Attributes:
        pose: [N,J,3] axis-angle.
        transl: [N,3] metres.
        betas: [S].
        landmarks: [N,33,3] of the fitted body, world.
        landmark_confidence: [N,33] in [0,1].
        image_error: weighted mean distance to the seen landmarks, metres at the person's depth.
        costs: mean cost per frame of each term at the end.
    """

    pose: Tensor
    transl: Tensor
    betas: Tensor
    landmarks: Tensor
    landmark_confidence: Tensor
    image_error: float
    costs: dict[str, float]


def fit_body(
    body: BodyModel,
    seen: Observations,
    config: FitConfig,
    progress: Callable[[int, int, str], None] | None = None,
    masks: NDArray[np.uint8] | None = None,
) -> Fit:
    """Fit one shape and N poses.

    First joints follow the network's 3D (any facing is a good start), then a linear solve places the body, then
    everything follows the image under an annealed Geman-McClure cost, at last with the body's outline against the
    masks'.

    Args:
        body: any body whose joints `priors.RULES` know.
        seen: the observations, frames of a person only.
        config: the knobs.
        progress: called with steps done and in total.
        masks: [N,H,W] uint8, the visible person, edges at `masks.EDGE`; None leaves outlines out.

    Raises:
        ValueError: there are no frames, or another number of masks.
    """
    if len(seen.points) == 0:
        raise ValueError("expected at least one frame with landmarks, got none")
    if masks is not None and len(masks) != len(seen.points):
        raise ValueError(f"expected one mask for each of {len(seen.points)} frames, got {len(masks)}")
    seen = _doubled(seen)
    betas = body.default_betas.double()
    prior = build_prior(body, betas)
    reduced = reduce_body(body, prior.free, betas)
    objective = Objective(prior, pose_weights(reduced, seen, config), seen, differences(seen), betas, config)
    rounds = OUTLINE_ROUNDS if masks is not None and masks.any() and config.outline > 0 else 0
    total = config.iterations * (1 + len(SCALES) + rounds)

    def stage(state: State, number: int, scale: float | None, goal: Objective = objective) -> State:
        start, most = config.iterations * number, config.iterations
        if goal.outline is not None:
            most = min(most, OUTLINE_STEPS)
        report = progress or (lambda done, total, note: None)
        return _descend(goal, reduced, state, scale, most, lambda i: report(start + i, total, "fitting the body"))

    state = stage(_start(objective, reduced), 0, None)
    state = replace(state, place=_place(reduced, state, seen))
    for i, scale in enumerate(SCALES):
        state = stage(state, i + 1, scale)
        # The shape model is linear round a point, so it is rebuilt where the shape has got to.
        reduced = reshape(reduced, body, state.betas)
    goal = objective
    for i in range(rounds):
        assert masks is not None
        edges = find_edges(reduced, make_skin(body, reduced), state, masks, seen.visible, seen.K)
        goal = replace(objective, outline=edges)
        state = stage(state, 1 + len(SCALES) + i, SCALES[-1], goal)
    return _finish(goal, reduced, state, body)


def _doubled(seen: Observations) -> Observations:
    """The same in float64, but for the shot numbers."""
    values = {f.name: getattr(seen, f.name) for f in fields(seen) if f.name != "shot"}
    return replace(seen, **{name: value.double() for name, value in values.items() if value is not None})


def _start(objective: Objective, reduced: ReducedBody) -> State:
    """Upright resting bodies, turned as the torso is seen, far enough away to be in view."""
    seen, prior = objective.seen, objective.prior
    n, f = len(seen.points), len(prior.free)
    eye = torch.eye(3).double().expand(1, f, 3, 3)
    rest, _ = reduced(eye, torch.zeros(1, 3).double(), reduced.base_betas)
    angles = torch.zeros(n, f, 3).double()
    angles[:, 1:] = (prior.axes.transpose(1, 2) @ prior.mean[..., None])[..., 0]
    place = torch.zeros(n, 3).double()
    return State(root_rotations(rest[0], seen), angles, place, reduced.base_betas, torch.zeros(()).double())


def _place(reduced: ReducedBody, state: State, seen: Observations) -> Tensor:
    """Root positions [N,3] from the linear solve, in front of the camera."""
    landmarks, _ = state.posed(reduced)
    place = state.place + translations(landmarks, seen)
    return torch.stack([place[:, 0], place[:, 1].clamp_min(10 * MIN_DEPTH), place[:, 2]], dim=1)


def _descend(
    objective: Objective,
    reduced: ReducedBody,
    state: State,
    scale: float | None,
    most: int,
    report: Callable[[int], None],
) -> State:
    """Take at most `most` steps of Levenberg-Marquardt with reweighting.

    Without `scale` the image is left out and bodies stay in place.
    """
    damping = FIRST_DAMPING
    for i in range(most):
        report(i + 1)
        linear = linearise(reduced, state)
        person = person_depth(linear.landmarks)
        before = sum(costs(objective, reduced, state, scale, person).values())
        normal = assemble(objective, reduced, state, linear, scale, person)
        after = before
        while damping < MAX_DAMPING:
            step = solve(normal, damping)
            if step is not None:
                trial = state.moved(*step, objective.config.beta_range)
                after = sum(costs(objective, reduced, trial, scale, person).values())
                if after < before:
                    state, damping = trial, max(damping / 5, 1e-9)
                    break
            damping *= 5
        if before - after <= ENOUGH * before:
            break
    return state


def _finish(objective: Objective, reduced: ReducedBody, state: State, body: BodyModel) -> Fit:
    seen = objective.seen
    landmarks, _ = state.posed(reduced)
    person = person_depth(landmarks)
    error = image_offsets(landmarks, seen, person).norm(dim=-1)
    final = costs(objective, reduced, state, SCALES[-1], person)
    angles = torch.cat([matrix_to_axis_angle(state.rotations()[:, :1]), state.angles[:, 1:]], dim=1)
    return Fit(
        pose=reduced.expand(angles, body.n_joints).to(body.default_betas),
        transl=state.transl(reduced).to(body.default_betas),
        betas=state.betas.to(body.default_betas),
        landmarks=landmarks,
        landmark_confidence=seen.visible * torch.exp(-((error / AGREEMENT) ** 2)),
        image_error=float((seen.visible * error).sum() / seen.visible.sum().clamp_min(1e-6)),
        costs={name: round(cost / len(landmarks), 4) for name, cost in final.items()},
    )
