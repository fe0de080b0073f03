"""The fit's cost, term by term, and its normal equations."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ahoy_core.perceive.ground import (
    BALANCE_SCALE,
    BALANCE_SPREAD,
    GROUND_SCALE,
    GROUND_SPREAD,
    SOLES,
    imbalance,
    standing,
)
from ahoy_core.perceive.normal import Normal, add_rows, empty_normal
from ahoy_core.perceive.outline import (
    OUTLINE_SCALE,
    OUTLINE_SPREAD,
    Outline,
    outline_offsets,
    outline_rows,
)
from ahoy_core.perceive.priors import PosePrior
from ahoy_core.perceive.reduced import ReducedBody
from ahoy_core.perceive.residuals import (
    LANDMARK_SPREAD,
    WORLD_SPREAD,
    Differences,
    Observations,
    apply_differences,
    centred,
    geman_mcclure,
    geman_mcclure_weight,
    image_derivatives,
    image_offsets,
    world_offsets,
)
from ahoy_core.perceive.state import Linearised, State, below

ACCELERATION_SPREAD = 8.0  # m/s^2 of a joint in everyday movement
DEPTH_SPEED = 0.5  # m/s along the line of sight: what the image hardly shows is held still
SHAPE_SPREAD = 0.02  # metres, root mean square over the surface, that one shape parameter departs from the average
# Adults born in 1996, worldwide: women 1.59 m, men 1.71 m on average (NCD Risk Factor Collaboration, eLife 2016), with
# some 7 cm of spread in each; together a mean of 1.65 and a spread of 0.09.
STATURE, STATURE_SPREAD = 1.65, 0.09
SCALE_SPREAD = 0.1  # of the logarithm of the network's metre
WORLD_SCALE = 0.4  # metres: width of Geman-McClure on the network's 3D
SEEN_SHARE = 0.05  # of the pose prior that stays on joints that move a visible landmark
LIMIT_SPREAD = 0.05  # radians beyond a joint's limit
TURN_RATE = 3.0  # rad/s of a joint: holds twists that no landmark shows


@dataclass(frozen=True)
class FitConfig:
    """Knobs of the fit.

    Attributes:
        iterations: most Gauss-Newton steps in each stage.
        smoothing: weight of the accelerations. 0 leaves hidden joints to each frame alone; large values make visible
            ones lag.
        pose_prior: weight of the pose prior on joints of which nothing is seen; `SEEN_SHARE` of it on the others.
        world_weight: weight of the network's own 3D against the image.
        outline: weight of the masks' outlines; 0 leaves them out.
        beta_range: bounds of every shape parameter; None for a body whose parameters are unbounded.
    """

    iterations: int = 10
    smoothing: float = 1.0
    pose_prior: float = 3.0
    world_weight: float = 1.0
    outline: float = 1.0
    beta_range: tuple[float, float] | None = (0.0, 1.0)


@dataclass(frozen=True)
class Objective:
    """Everything that stays the same while the state is sought.

    Attributes:
        prior: of the pose.
        pose_weights: [N,F-1] of the pose prior, see `pose_weights`.
        seen: the observations.
        steps: differences in time.
        average: [S] shape that the prior tends to, size apart.
        config: the knobs.
        outline: places of the body's outline and where the masks end, if they are to agree.
    """

    prior: PosePrior
    pose_weights: Tensor
    seen: Observations
    steps: Differences
    average: Tensor
    config: FitConfig
    outline: Outline | None = None


def pose_weights(reduced: ReducedBody, seen: Observations, config: FitConfig) -> Tensor:
    """Weights [N,F-1] of the pose prior: strong on joints that move no visible landmark, weak on the others.

    One weight for all either leaves hidden limbs to the network's guesses or keeps visible ones from bending.
    """
    moves = reduced.moments[..., 3] @ below(reduced.parents).to(reduced.moments).T > 0.5
    known = torch.where(moves[None], seen.visible[..., None], 0.0).amax(1)[:, 1:]
    return config.pose_prior * (SEEN_SHARE + (1 - SEEN_SHARE) * (1 - known))


def costs(
    objective: Objective, reduced: ReducedBody, state: State, scale: float | None, person: Tensor
) -> dict[str, float]:
    """Sum over the frames of each term; without `scale` the image is left out.

    Args:
        objective: what is fitted.
        reduced: the body.
        state: where to evaluate.
        scale: width of the robust image cost, metres.
        person: [N] metres, see `residuals.person_depth`.
    """
    landmarks, joints = state.posed(reduced)
    terms = {
        **_seen_terms(objective, landmarks, state, scale, person),
        **_outline_terms(objective, reduced, state, person),
        **_prior_terms(objective, reduced, joints, state),
    }
    return {name: float(cost) for name, cost in terms.items()}


def _seen_terms(
    objective: Objective, landmarks: Tensor, state: State, scale: float | None, person: Tensor
) -> dict[str, Tensor]:
    seen, config = objective.seen, objective.config
    squared = world_offsets(landmarks, seen, state.log_scale).square().sum(-1)
    world = (seen.world_weights * geman_mcclure(squared, WORLD_SCALE)).sum() / WORLD_SPREAD**2
    terms = {"world": config.world_weight * world}
    if scale is not None:
        squared = image_offsets(landmarks, seen, person).square().sum(-1)
        terms["image"] = (seen.weights * geman_mcclure(squared, scale)).sum() / LANDMARK_SPREAD**2
    if seen.ground is not None:
        height, _ = standing(landmarks, seen.ground)
        terms["ground"] = geman_mcclure(height.square(), GROUND_SCALE).sum() / GROUND_SPREAD**2
        leaning = imbalance(landmarks, seen.ground).square().sum(-1)
        terms["balance"] = geman_mcclure(leaning, BALANCE_SCALE).sum() / BALANCE_SPREAD**2
    return terms


def _outline_terms(objective: Objective, reduced: ReducedBody, state: State, person: Tensor) -> dict[str, Tensor]:
    if objective.outline is None:
        return {}
    offsets = outline_offsets(reduced, state, objective.outline, objective.seen.K, person)
    robust = geman_mcclure(offsets.square(), OUTLINE_SCALE)
    return {"outline": objective.config.outline * (objective.outline.weights * robust).sum() / OUTLINE_SPREAD**2}


def _prior_terms(objective: Objective, reduced: ReducedBody, joints: Tensor, state: State) -> dict[str, Tensor]:
    steps, config, prior = objective.steps, objective.config, objective.prior
    bend = apply_differences(joints, steps.bend_first, steps.bend)
    speed = apply_differences(state.place[:, 1], steps.speed_first, steps.speed)
    turn = apply_differences(state.angles[:, 1:], steps.speed_first, steps.speed)
    return {
        "pose": (objective.pose_weights[..., None] * prior.departure(state.angles[:, 1:]).square()).sum(),
        "limits": prior.beyond(state.angles[:, 1:]).square().sum() / LIMIT_SPREAD**2,
        "smoothness": config.smoothing * bend.square().sum() / ACCELERATION_SPREAD**2,
        "turning": config.smoothing * turn.square().sum() / TURN_RATE**2,
        "depth": speed.square().sum() / DEPTH_SPEED**2,
        "shape": _shape_weights(reduced, objective) @ (state.betas - objective.average).square()
        + len(joints) * (state.log_scale / SCALE_SPREAD) ** 2,
        "stature": len(joints) * ((reduced.shaped_stature(state.betas) - STATURE) / STATURE_SPREAD) ** 2,
    }


def _shape_weights(reduced: ReducedBody, objective: Objective) -> Tensor:
    """Weights [S] of squared departures: what a parameter does to the surface decides, whatever its unit."""
    return len(objective.seen.points) * (reduced.reach / SHAPE_SPREAD) ** 2


def assemble(
    objective: Objective,
    reduced: ReducedBody,
    state: State,
    linear: Linearised,
    scale: float | None,
    person: Tensor,
) -> Normal:
    """Build the normal equations of `costs` at a state (reweighted: their gradient is half of the cost's)."""
    n, f = state.angles.shape[:2]
    normal = empty_normal(n, 3 * f + 3, len(state.betas) + 1)
    _add_seen(normal, objective, state, linear, scale, person)
    _add_outline(normal, objective, reduced, state, person)
    _add_temporal(normal, objective, state, linear)
    _add_angles(normal, objective, state)
    weights = _shape_weights(reduced, objective)
    weights = torch.cat([weights, weights.new_tensor([n / SCALE_SPREAD**2])])
    normal.corner.diagonal().add_(weights)
    normal.clip_gradient.add_(weights * torch.cat([state.betas - objective.average, state.log_scale[None]]))
    _add_stature(normal, reduced, state)
    if scale is None:
        _freeze_place(normal, 3 * f)
    return normal


def _add_rows(normal: Normal, residuals: Tensor, rows: Tensor, per_frame: int) -> None:
    """Add residuals [N,K,C] of single frames with derivatives [N,K,C,P+G]."""
    flat = rows.flatten(1, 2)
    first = torch.arange(len(rows))
    add_rows(normal, residuals.flatten(1), (flat[..., :per_frame],), flat[..., per_frame:], first)


def _add_seen(
    normal: Normal, objective: Objective, state: State, linear: Linearised, scale: float | None, person: Tensor
) -> None:
    seen, config = objective.seen, objective.config
    per_frame = normal.gradient.shape[1]
    offsets = world_offsets(linear.landmarks, seen, state.log_scale)
    rows = centred(linear.d_landmarks, seen.world_weights)
    rows[..., -1] = -state.log_scale.exp() * centred(seen.world, seen.world_weights)
    weights = seen.world_weights * geman_mcclure_weight(offsets.square().sum(-1), WORLD_SCALE)
    root = (config.world_weight * weights).sqrt()[..., None] / WORLD_SPREAD
    _add_rows(normal, root * offsets, root[..., None] * rows, per_frame)
    _add_ground(normal, objective, linear)
    if scale is None:
        return
    offsets = image_offsets(linear.landmarks, seen, person)
    rows = image_derivatives(linear.landmarks, person) @ linear.d_landmarks
    weights = seen.weights * geman_mcclure_weight(offsets.square().sum(-1), scale)
    root = weights.sqrt()[..., None] / LANDMARK_SPREAD
    _add_rows(normal, root * offsets, root[..., None] * rows, per_frame)


def _add_ground(normal: Normal, objective: Objective, linear: Linearised) -> None:
    ground = objective.seen.ground
    if ground is None:
        return
    height, slopes = standing(linear.landmarks, ground)
    rows = torch.einsum("nkip,nrki->nrp", linear.d_landmarks[:, list(SOLES)], slopes)
    root = geman_mcclure_weight(height.square(), GROUND_SCALE).sqrt() / GROUND_SPREAD
    per_frame = normal.gradient.shape[1]
    _add_rows(normal, (root * height)[:, None], (root[..., None] * rows)[:, None], per_frame)
    leaning = imbalance(linear.landmarks, ground)
    rows = imbalance(linear.d_landmarks.permute(0, 3, 1, 2), ground).transpose(1, 2)
    root = geman_mcclure_weight(leaning.square().sum(-1), BALANCE_SCALE).sqrt()[:, None] / BALANCE_SPREAD
    _add_rows(normal, (root * leaning)[:, None], (root[..., None] * rows)[:, None], per_frame)


def _add_outline(normal: Normal, objective: Objective, reduced: ReducedBody, state: State, person: Tensor) -> None:
    outline = objective.outline
    if outline is None:
        return
    offsets, rows = outline_rows(reduced, state, outline, objective.seen.K, person)
    weights = objective.config.outline * outline.weights * geman_mcclure_weight(offsets.square(), OUTLINE_SCALE)
    root = weights.sqrt() / OUTLINE_SPREAD
    per_frame = normal.gradient.shape[1]
    _add_rows(normal, (root * offsets)[..., None], (root[..., None] * rows)[:, :, None], per_frame)


def _add_stature(normal: Normal, reduced: ReducedBody, state: State) -> None:
    row = torch.cat([reduced.stature_slopes, reduced.stature_slopes.new_zeros(1)]) / STATURE_SPREAD
    n = len(normal.gradient)
    normal.corner.add_(n * torch.outer(row, row))
    normal.clip_gradient.add_(n * row * (reduced.shaped_stature(state.betas) - STATURE) / STATURE_SPREAD)


def _add_temporal(normal: Normal, objective: Objective, state: State, linear: Linearised) -> None:
    steps, config = objective.steps, objective.config
    per_frame = normal.gradient.shape[1]
    joints, rows = linear.joints.flatten(1), linear.d_joints.flatten(1, 2)
    scale = config.smoothing**0.5 / ACCELERATION_SPREAD
    _add_differences(normal, steps.bend_first, scale * steps.bend, joints, rows, per_frame)
    identity = torch.eye(per_frame).to(joints).expand(len(joints), -1, -1)
    unknowns = torch.cat([state.angles.flatten(1), state.place], dim=1)
    moving = slice(3, per_frame - 3)
    scale = config.smoothing**0.5 / TURN_RATE
    _add_differences(
        normal, steps.speed_first, scale * steps.speed, unknowns[:, moving], identity[:, moving], per_frame
    )
    depth = slice(per_frame - 2, per_frame - 1)
    _add_differences(
        normal, steps.speed_first, steps.speed / DEPTH_SPEED, unknowns[:, depth], identity[:, depth], per_frame
    )


def _add_differences(
    normal: Normal, first: Tensor, coefficients: Tensor, values: Tensor, rows: Tensor, per_frame: int
) -> None:
    """Add finite differences of values [N,R] with derivatives [N,R,P] or [N,R,P+G]."""
    if len(first) == 0:
        return
    residuals = apply_differences(values, first, coefficients)
    parts = tuple(coefficients[:, i, None, None] * rows[first + i] for i in range(coefficients.shape[1]))
    clip = torch.stack([part[..., per_frame:] for part in parts]).sum(0)
    if clip.shape[-1] == 0:
        clip = clip.new_zeros(*clip.shape[:2], len(normal.clip_gradient))
    add_rows(normal, residuals, tuple(part[..., :per_frame] for part in parts), clip, first)


def _add_angles(normal: Normal, objective: Objective, state: State) -> None:
    """Prior and limits touch single joints: blocks of three on the diagonal."""
    prior, angles = objective.prior, state.angles[:, 1:]
    beyond = prior.beyond(angles)
    strength = objective.pose_weights[..., None]
    weights = strength / prior.spread**2 + (beyond != 0) / LIMIT_SPREAD**2
    pull = strength * prior.departure(angles) / prior.spread + beyond / LIMIT_SPREAD**2
    blocks = torch.einsum("fai,nfa,faj->nfij", prior.axes, weights, prior.axes)
    gradient = torch.einsum("fai,nfa->nfi", prior.axes, pull)
    for joint in range(angles.shape[1]):
        rows = slice(3 * joint + 3, 3 * joint + 6)
        normal.blocks[0][:, rows, rows] += blocks[:, joint]
        normal.gradient[:, rows] += gradient[:, joint]


def _freeze_place(normal: Normal, start: int) -> None:
    """Cut bodies' places and the clip's numbers out of the equations, so that only joints move."""
    for block in normal.blocks:
        block[:, start:, :] = 0
        block[:, :, start:] = 0
    normal.blocks[0].diagonal(dim1=1, dim2=2)[:, start:] = 1
    normal.gradient[:, start:] = 0
    normal.border.zero_()
    normal.clip_gradient.zero_()
