"""The body fitted to landmarks over the whole clip: one shape, a pose per frame (paper section 3.1, in the place of NLF)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ahoy_core.body.canonical import canonical_pose
from ahoy_core.body.model import BodyModel
from ahoy_core.body.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from ahoy_core.perceive.lift import root_rotations, translations
from ahoy_core.perceive.priors import PosePrior, build_prior
from ahoy_core.perceive.reduced import ReducedBody, reduce_body, reshape
from ahoy_core.perceive.residuals import (
    MIN_DEPTH,
    Observations,
    acceleration,
    depth_velocity,
    image_cost,
    image_offsets,
    world_cost,
)

ACCELERATION_SPREAD = 8.0  # m/s^2 of a joint in everyday movement
DEPTH_SPEED = 0.5  # m/s along the line of sight: what the image hardly shows is held still
SHAPE_SPREAD = 0.02  # metres, root mean square over the landmarks, that one shape parameter departs from the average
SCALE_SPREAD = 0.1  # of the logarithm of the network's metre
SCALES = (0.5, 0.25, 0.15, 0.1)  # metres: widths of Geman-McClure on the image, one after the other
WORLD_SCALE = 0.4  # metres
HISTORY = 20  # gradients that L-BFGS remembers
LIMIT_SPREAD = 0.05  # radians beyond a joint's limit
AGREEMENT = 0.08  # metres of image error at which confidence in a landmark has dropped to 1/e


@dataclass(frozen=True)
class FitConfig:
    """Knobs of the fit.

    Attributes:
        iterations: gradient steps of the main stage; a third as many come before it, on 3D alone.
        smoothing: weight of the accelerations. 0 leaves hidden joints to each frame alone; large values make visible ones lag.
        pose_prior: weight of the pose prior.
        world_weight: weight of the network's own 3D against the image.
        beta_range: bounds of every shape parameter; None for a body whose parameters are unbounded.
    """

    iterations: int = 200
    smoothing: float = 1.0
    pose_prior: float = 0.3
    world_weight: float = 1.0
    beta_range: tuple[float, float] | None = (0.0, 1.0)


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


@dataclass(frozen=True)
class _State:
    """What is optimised.

    Attributes:
        root: [N,3,3] first root rotations, fixed.
        turn: [N,3] rotation vectors to their right.
        angles: [N,F-1,3] rotation vectors of the other moving joints.
        place: [N,3] of the root joint: its ray's x and z for y = 1, and the logarithm of its depth. Moving along the ray keeps the
            person's place in the image, so that the two don't fight.
        betas: [S].
        log_scale: [] of the network's metre.
    """

    root: Tensor
    turn: Tensor
    angles: Tensor
    place: Tensor
    betas: Tensor
    log_scale: Tensor

    def rotations(self) -> Tensor:
        turned = self.root @ axis_angle_to_matrix(self.turn)
        return torch.cat([turned[:, None], axis_angle_to_matrix(self.angles)], dim=1)

    def transl(self, reduced: ReducedBody) -> Tensor:
        depth = self.place[:, 2].exp()
        root = torch.stack([self.place[:, 0] * depth, depth, self.place[:, 1] * depth], dim=1)
        return root - reduced.rest_joints(self.betas)[0]


@dataclass(frozen=True)
class _Problem:
    body: BodyModel
    prior: PosePrior
    seen: Observations
    config: FitConfig


def fit_body(
    body: BodyModel,
    seen: Observations,
    config: FitConfig,
    progress: Callable[[int, int, str], None] | None = None,
) -> Fit:
    """Fit one shape and N poses.

    First joints follow the network's 3D (any facing is a good start), then a linear solve places the body, then everything follows the
    image under an annealed Geman-McClure cost.

    Args:
        body: any body whose joints `priors.RULES` know.
        seen: the observations, frames of a person only.
        config: the knobs.
        progress: called with steps done and in total.

    Raises:
        ValueError: there are no frames.
    """
    if len(seen.points) == 0:
        raise ValueError("expected at least one frame with landmarks, got none")
    betas = body.default_betas.to(seen.points)
    prior = build_prior(body, betas, canonical_pose(body).to(seen.points))
    problem = _Problem(body, prior, seen, config)
    reduced = reduce_body(body, prior.free, betas)
    state = _start(problem, reduced)
    first = math.ceil(config.iterations / 3)
    share = math.ceil(config.iterations / len(SCALES))
    total = first + share * len(SCALES)

    def report(done: int) -> None:
        if progress:
            progress(done, total, "fitting the body")

    state = _minimise(problem, reduced, state, first, None, report)
    with torch.no_grad():
        landmarks, _ = reduced(state.rotations(), torch.zeros_like(state.turn), state.betas)
        root = translations(landmarks, seen) + reduced.rest_joints(state.betas)[0]
        depth = root[:, 1].clamp_min(MIN_DEPTH)
        state = replace(state, place=torch.stack([root[:, 0] / depth, root[:, 2] / depth, depth.log()], dim=1))
    for i, scale in enumerate(SCALES):
        state = _minimise(problem, reduced, state, share, scale, lambda k, i=i: report(first + share * i + k))
        # The shape model is linear round a point, so it is rebuilt where the shape has got to.
        reduced = reshape(reduced, body, state.betas)
    return _finish(problem, reduced, state)


def _start(problem: _Problem, reduced: ReducedBody) -> _State:
    seen, prior = problem.seen, problem.prior
    n, f = len(seen.points), len(prior.free)
    eye = torch.eye(3).to(seen.points).expand(1, f, 3, 3)
    zero = seen.points.new_zeros(n, 3)
    rest, _ = reduced(eye, zero[:1], reduced.base_betas)
    mean = (prior.axes.transpose(1, 2) @ prior.mean[..., None])[..., 0]
    return _State(
        root=root_rotations(rest[0], seen),
        turn=zero,
        angles=mean.expand(n, -1, -1),
        place=zero,
        betas=reduced.base_betas,
        log_scale=seen.points.new_zeros(()),
    )


def _costs(problem: _Problem, reduced: ReducedBody, state: _State, scale: float | None) -> dict[str, Tensor]:
    """Mean cost per frame of each term; without `scale` the image is left out."""
    seen, config = problem.seen, problem.config
    landmarks, joints = reduced(state.rotations(), state.transl(reduced), state.betas)
    n = len(landmarks)
    departure = problem.prior.residuals(state.angles, LIMIT_SPREAD).square().sum((2, 3))
    step = state.betas - problem.body.default_betas.to(state.betas)
    reach = reduced.moment_slopes.sum(2)[..., :3].square().sum(-1).mean(-1)
    costs = {
        "world": config.world_weight * world_cost(landmarks, seen, state.log_scale, WORLD_SCALE).mean(),
        "pose": config.pose_prior * departure[:, 0].mean(),
        "limits": departure[:, 1].mean(),
        "smoothness": config.smoothing * (acceleration(joints, seen) / ACCELERATION_SPREAD).square().sum() / n,
        "depth": (depth_velocity(joints[:, 0], seen) / DEPTH_SPEED).square().sum() / n,
        "shape": (step.square() * reach).sum() / SHAPE_SPREAD**2 + (state.log_scale / SCALE_SPREAD) ** 2,
    }
    if scale is not None:
        costs["image"] = image_cost(landmarks, seen, scale).mean()
    return costs


def _minimise(
    problem: _Problem,
    reduced: ReducedBody,
    state: _State,
    steps: int,
    scale: float | None,
    report: Callable[[int], None],
) -> _State:
    """Run L-BFGS for a number of evaluations; without `scale` only joints move and the image is left out."""
    names = ("turn", "angles") if scale is None else ("turn", "angles", "place", "betas", "log_scale")
    leaves = {name: getattr(state, name).detach().clone().requires_grad_() for name in names}
    optimiser = torch.optim.LBFGS(
        list(leaves.values()), max_iter=steps, max_eval=steps, history_size=HISTORY, line_search_fn="strong_wolfe"
    )
    done = 0

    def closure() -> Tensor:
        nonlocal done
        optimiser.zero_grad()
        cost = torch.stack(list(_costs(problem, reduced, replace(state, **leaves), scale).values())).sum()
        cost.backward()
        done += 1
        report(min(done, steps))
        return cost

    optimiser.step(closure)
    state = replace(state, **{name: leaf.detach() for name, leaf in leaves.items()})
    bounds = problem.config.beta_range
    return replace(state, betas=state.betas.clamp(*bounds)) if bounds else state


def _finish(problem: _Problem, reduced: ReducedBody, state: _State) -> Fit:
    seen = problem.seen
    with torch.no_grad():
        rotations = state.rotations()
        landmarks, _ = reduced(rotations, state.transl(reduced), state.betas)
        error = image_offsets(landmarks, seen).norm(dim=-1)
        costs = _costs(problem, reduced, state, SCALES[-1])
        root = matrix_to_axis_angle(rotations[:, :1])
        weight = seen.weights.sum().clamp_min(1e-6)
        return Fit(
            pose=reduced.expand(torch.cat([root, state.angles], dim=1), problem.body.n_joints),
            transl=state.transl(reduced),
            betas=state.betas,
            landmarks=landmarks,
            landmark_confidence=seen.weights * torch.exp(-((error / AGREEMENT) ** 2)),
            image_error=float((seen.weights * error).sum() / weight),
            costs={name: round(float(cost), 4) for name, cost in costs.items()},
        )
