"""Derivatives by hand against automatic ones, and the reduced body against the whole one."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from ahoy_core.body.keypoints import keypoints
from ahoy_core.body.packaged import PackagedBody
from ahoy_core.body.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from ahoy_core.perceive.normal import add_rows, empty_normal, solve
from ahoy_core.perceive.objective import FitConfig, Objective, assemble, costs, pose_weights
from ahoy_core.perceive.priors import build_prior
from ahoy_core.perceive.reduced import ReducedBody, reduce_body, reshape
from ahoy_core.perceive.residuals import (
    Observations,
    differences,
    geman_mcclure,
    image_derivatives,
    image_offsets,
    person_depth,
    safe_depth,
    world_offsets,
)
from ahoy_core.perceive.state import State, linearise, right_jacobian
from tests.perceive.synthetic import make_scene, weighted

FRAMES = 4


def double(seen: Observations) -> Observations:
    names = ("points", "weights", "world", "world_weights", "visible", "times", "K")
    return replace(seen, **{k: getattr(seen, k).double() for k in names})


def setting(body: PackagedBody, seed: int = 0) -> tuple[Objective, ReducedBody, State]:
    """A state in general position: limits exceeded here and there, landmarks of all weights."""
    draw = torch.Generator().manual_seed(seed)
    seen = double(make_scene(body, FRAMES).seen)
    seen = weighted(seen, torch.rand(FRAMES, 33, generator=draw).double())
    # A floor near the soles, and tilted, so that it bears on every number.
    seen = replace(seen, ground=torch.tensor([0.1, -0.17, 0.98, 1.2]).double())
    betas = body.default_betas.double()
    prior = build_prior(body, betas)
    reduced = reduce_body(body, prior.free, betas)
    config = FitConfig()
    objective = Objective(prior, pose_weights(reduced, seen, config), seen, differences(seen), betas, config)
    f = len(prior.free)
    state = State(
        root=axis_angle_to_matrix(torch.randn(FRAMES, 3, generator=draw)).double(),
        angles=0.4 * torch.randn(FRAMES, f, 3, generator=draw).double(),
        place=torch.tensor([0.1, 3.0, 0.2]).double() + 0.1 * torch.randn(FRAMES, 3, generator=draw).double(),
        betas=betas + 0.05 * torch.randn(len(betas), generator=draw).double(),
        log_scale=torch.tensor(0.1).double(),
    )
    return objective, reduced, state


def test_the_reduced_body_has_the_landmarks_of_the_whole_body(body: PackagedBody) -> None:
    _, reduced, state = setting(body)
    reduced = reshape(reduced, body, state.betas)
    ours, joints = state.posed(reduced)
    rotations = state.rotations().float()
    pose = torch.zeros(FRAMES, body.n_joints, 3)
    pose[:, list(reduced.free)] = matrix_to_axis_angle(rotations)
    whole = body(pose, state.betas.float()[None], state.transl(reduced).float())
    # Float32 of the whole body, metres.
    torch.testing.assert_close(ours.float(), keypoints(body, whole), atol=2e-5, rtol=0)
    torch.testing.assert_close(joints.float(), whole.joints[:, list(reduced.free)], atol=2e-5, rtol=0)


def test_stature_stays_what_people_differ_by_where_age_would_do(body: PackagedBody) -> None:
    """A little below adult age, age makes a body larger more evenly than stature does: a child would be as likely."""
    _, reduced, _ = setting(body)
    height, age = (body.beta_names.index(name) for name in ("height", "age"))
    young = reduced.base_betas.clone()
    young[age] -= 0.07
    moved = reshape(reduced, body, young)
    assert reduced.size == moved.size == height
    assert reduce_body(body, reduced.free, young).size == age, "this shape does not try what the test is for"
    assert float(moved.reach[age]) > 5 * float(moved.reach[height])


def test_derivatives_by_hand_equal_automatic_ones(body: PackagedBody) -> None:
    _, reduced, state = setting(body)
    linear = linearise(reduced, state)
    n, f = state.angles.shape[:2]
    for frame, landmark, axis in ((0, 15, 0), (1, 31, 1), (2, 0, 2)):
        leaves = [t.clone().requires_grad_() for t in (state.angles, state.place, state.betas)]
        moved = replace(state, angles=leaves[0], place=leaves[1], betas=leaves[2])
        landmarks, joints = moved.posed(reduced)
        for value, row in (
            (landmarks[frame, landmark, axis], linear.d_landmarks[frame, landmark, axis]),
            (joints[frame, -3, axis], linear.d_joints[frame, -3, axis]),
        ):
            angles, place, betas = torch.autograd.grad(value, leaves, retain_graph=True)
            expected = torch.cat([angles[frame].flatten(), place[frame], betas, betas.new_zeros(1)])
            # The landmark weights are float32 and sum to 1 within 1e-8 only.
            torch.testing.assert_close(row, expected, atol=1e-7, rtol=1e-6)
    assert linear.d_landmarks.shape == (n, 33, 3, 3 * f + 3 + len(state.betas) + 1)


@pytest.mark.parametrize("scale", [None, 0.2])
def test_the_normal_equations_hold_half_of_the_costs_gradient(body: PackagedBody, scale: float | None) -> None:
    objective, reduced, state = setting(body)
    linear = linearise(reduced, state)
    person = person_depth(linear.landmarks)
    normal = assemble(objective, reduced, state, linear, scale, person)
    generator = torch.Generator().manual_seed(3)
    frames = torch.randn(normal.gradient.shape, generator=generator).double()
    clip = torch.randn(normal.clip_gradient.shape, generator=generator).double()
    if scale is None:
        frames[:, -3:], clip[:] = 0, 0
    step = 1e-6

    def along(sign: float) -> float:
        there = state.moved(sign * step * frames, sign * step * clip, None)
        return sum(costs(objective, reduced, there, scale, person).values())

    slope = (along(1) - along(-1)) / (2 * step)
    ours = 2 * float((normal.gradient * frames).sum() + (normal.clip_gradient * clip).sum())
    assert ours == pytest.approx(slope, rel=1e-5)


def test_residuals_pass_gradcheck_in_float64(body: PackagedBody) -> None:
    seen = double(make_scene(body, 2).seen)
    generator = torch.Generator().manual_seed(1)
    points = torch.randn(2, 33, 3, generator=generator).double() + torch.tensor([0.0, 2.0, 0.0])
    points.requires_grad_()
    log_scale = torch.tensor(0.1).double().requires_grad_()
    person = torch.tensor([2.0, 3.0]).double()

    def image(p: Tensor) -> Tensor:
        return geman_mcclure(image_offsets(p, seen, person).square().sum(-1), 0.3)

    assert torch.autograd.gradcheck(image, (points,))
    assert torch.autograd.gradcheck(lambda p, s: world_offsets(p, seen, s), (points, log_scale))
    assert torch.autograd.gradcheck(right_jacobian, (points[0].detach().requires_grad_(),))


def test_image_derivatives_equal_automatic_ones_even_behind_the_camera(body: PackagedBody) -> None:
    seen = double(make_scene(body, 1).seen)
    points = torch.randn(1, 33, 3, generator=torch.Generator().manual_seed(2)).double()
    person = torch.tensor([2.0]).double()
    ours = image_derivatives(points, person)
    automatic = torch.autograd.functional.jacobian(lambda p: image_offsets(p[None], seen, person)[0], points[0])
    # torch's softplus is linear beyond 20, which is off by e^-20.
    torch.testing.assert_close(ours[0], torch.einsum("kikc->kic", automatic), rtol=1e-8, atol=1e-8)
    assert torch.isfinite(ours).all()
    assert bool((safe_depth(torch.tensor([-1e6, -1.0, 0.0])) > 0).all())


def test_the_banded_solver_solves_what_the_dense_matrix_says() -> None:
    generator = torch.Generator().manual_seed(0)
    n, p, g = 5, 3, 2
    normal = empty_normal(n, p, g)
    dense_rows, right = [], []
    for first, span in ((torch.arange(n), 1), (torch.arange(n - 1), 2), (torch.arange(n - 2), 3)):
        rows = tuple(torch.randn(len(first), 4, p, generator=generator).double() for _ in range(span))
        clip = torch.randn(len(first), 4, g, generator=generator).double()
        residuals = torch.randn(len(first), 4, generator=generator).double()
        add_rows(normal, residuals, rows, clip, first)
        for m, start in enumerate(first.tolist()):
            block = torch.zeros(4, n * p + g).double()
            for a in range(span):
                block[:, (start + a) * p : (start + a + 1) * p] = rows[a][m]
            block[:, n * p :] = clip[m]
            dense_rows.append(block)
            right.append(residuals[m])
    expected = torch.linalg.lstsq(torch.cat(dense_rows), -torch.cat(right)[:, None]).solution[:, 0]
    step = solve(normal, 0.0)
    assert step is not None
    torch.testing.assert_close(torch.cat([step[0].flatten(), step[1]]), expected, rtol=1e-5, atol=1e-7)
