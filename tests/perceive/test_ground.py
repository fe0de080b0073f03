"""Somebody stands on a known floor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from ahoy_core.body.keypoints import keypoints
from ahoy_core.body.packaged import PackagedBody
from ahoy_core.body.rotations import axis_angle_to_matrix
from ahoy_core.conventions import look_at
from ahoy_core.perceive import objective
from ahoy_core.perceive.fit import fit_body
from ahoy_core.perceive.ground import (
    BALANCE_SCALE,
    CLEARANCE,
    SOLES,
    TRUNK,
    ground_from_camera,
    imbalance,
    standing,
)
from ahoy_core.perceive.objective import FitConfig
from ahoy_core.perceive.residuals import Observations, geman_mcclure_weight
from tests.perceive.synthetic import average_betas, make_scene


def test_the_floor_is_found_from_where_the_camera_stands() -> None:
    view = look_at(torch.tensor([1.0, -3.0, 1.5]), torch.tensor([0.0, 0.0, 0.5])).double().numpy()
    ground = ground_from_camera(view).numpy()
    assert np.linalg.norm(ground[:3]) == pytest.approx(1.0) and ground[3] == pytest.approx(1.5)
    # A point of the floor, in the camera's axes and then in those of the observed world, is at height 0.
    camera = view[:3, :3] @ np.array([0.3, 0.4, 0.0]) + view[:3, 3]
    observed = np.array([camera[0], camera[2], -camera[1]])
    assert ground[:3] @ observed + ground[3] == pytest.approx(0.0, abs=1e-6)


def soles(left: tuple[float, float], right: tuple[float, float]) -> torch.Tensor:
    """Landmarks [1,33,3] of feet whose (heel, toes) are this much higher than where they stand."""
    landmarks = torch.zeros(1, 33, 3, dtype=torch.float64)
    lifted = torch.tensor([left[0], right[0], left[1], right[1]]).double()
    landmarks[0, list(SOLES), 2] = torch.tensor(CLEARANCE).double() + lifted
    return landmarks


FLOOR = torch.tensor([0.0, 0.0, 1.0, 0.0]).double()


@pytest.mark.parametrize(
    ("left", "right", "heel", "toes"),
    [
        ((0.0, 0.0), (0.0, 0.0), 0.0, 0.0),  # on both feet
        ((0.0, 0.0), (0.3, 0.3), 0.0, 0.0),  # on one
        ((0.0, 0.15), (0.2, 0.0), 0.0, 0.0),  # between two steps
        ((0.1, 0.0), (0.1, 0.0), 0.1, 0.0),  # on tiptoe
        ((0.2, 0.2), (0.2, 0.2), 0.2, 0.2),  # in the air
    ],
)
def test_a_heel_and_toes_are_on_the_floor(
    left: tuple[float, float], right: tuple[float, float], heel: float, toes: float
) -> None:
    found = standing(soles(left, right), FLOOR)[0]
    torch.testing.assert_close(found, torch.tensor([[heel, toes]]).double(), atol=1e-3, rtol=0)


def test_the_floors_derivatives_are_right_while_weight_shifts() -> None:
    spread = torch.randn(6, 33, 3, generator=torch.Generator().manual_seed(0)).double()
    points = (soles((0.0, 0.0), (0.0, 0.0)) + 0.02 * spread).requires_grad_()
    for k in range(2):
        (slope,) = torch.autograd.grad(standing(points, FLOOR)[0][:, k].sum(), points)
        torch.testing.assert_close(slope[:, list(SOLES)], standing(points, FLOOR)[1][:, k].detach())


def stand(body: PackagedBody, betas: torch.Tensor) -> tuple[Observations, float, float]:
    """A standing person, how far away, and how high the floor is."""
    scene = make_scene(body, frames=4, betas=betas, rise=0.0)
    floor = float(body(scene.pose, betas[None], scene.transl).vertices[..., 2].min()) - 0.012
    # The knees bend while the root stays, so the soles leave the floor: only the first frame stands.
    still = replace(scene.seen, **{k: getattr(scene.seen, k)[:1].repeat(3, *[1] * (getattr(scene.seen, k).ndim - 1))
                                   for k in ("points", "weights", "world", "world_weights", "visible")},
                    times=scene.seen.times[:3], shot=scene.seen.shot[:3])  # fmt: skip
    return still, float(scene.transl[0, 1]), floor


# 0.085 and -0.176 m were measured: the stature's prior still pulls. With one toe alone on the floor -0.294, on tiptoe.
@pytest.mark.parametrize(("taller", "most"), [(-0.25, 0.12), (0.25, 0.2)])
def test_a_known_floor_tells_a_small_person_from_a_far_one(body: PackagedBody, taller: float, most: float) -> None:
    betas = average_betas(body)
    betas[body.beta_names.index("height")] += taller
    still, depth, floor = stand(body, betas)
    with_floor = replace(still, ground=torch.tensor([0.0, 0.0, 1.0, -floor]))
    blind, told = (fit_body(body, seen, FitConfig()) for seen in (still, with_floor))
    off, wrong = (float(fit.transl[:, 1].mean()) - depth for fit in (told, blind))
    assert abs(off) < min(most, abs(wrong))
    assert float(standing(told.landmarks, with_floor.ground.double())[0].abs().max()) < 0.05


def test_balance_is_along_the_floor_and_moves_with_what_stands_on_it() -> None:
    ground = torch.nn.functional.normalize(torch.tensor([0.1, -0.17, 0.98]).double(), dim=0)
    ground = torch.cat([ground, torch.tensor([1.2]).double()])
    landmarks = torch.randn(5, 33, 3, generator=torch.Generator().manual_seed(0)).double()
    apart = imbalance(landmarks, ground)
    torch.testing.assert_close(apart @ ground[:3], torch.zeros(5).double(), atol=1e-12, rtol=0)
    torch.testing.assert_close(imbalance(landmarks + 3.0, ground), apart)
    raised = landmarks.clone()
    raised[:, list(TRUNK)] += 0.7 * ground[:3]
    torch.testing.assert_close(imbalance(raised, ground), apart)
    raised[:, list(SOLES), 0] -= 0.1
    assert bool(((imbalance(raised, ground) - apart)[:, 0] > 0.09).all())


def test_who_sits_is_left_alone() -> None:
    sitting, leaning = geman_mcclure_weight(torch.tensor([0.45**2, 0.07**2]), BALANCE_SCALE)
    # On a chair the feet are half a metre before the trunk.
    assert float(sitting) < 0.05 * float(leaning)


def test_who_stands_on_a_known_floor_does_not_lean(body: PackagedBody, monkeypatch: pytest.MonkeyPatch) -> None:
    still, _, floor = stand(body, average_betas(body))
    # A network that does not know where the camera looks takes its axis for level: here it looks down by 10 degrees.
    tilt = axis_angle_to_matrix(torch.tensor([[0.17, 0.0, 0.0]]))[0]
    seen = replace(still, world=still.world @ tilt.T, ground=torch.tensor([0.0, 0.0, 1.0, -floor]))

    def lean() -> float:
        fit = fit_body(body, seen, FitConfig())
        landmarks = keypoints(body, body(fit.pose, fit.betas[None], fit.transl))
        return float(imbalance(landmarks, seen.ground).norm(dim=-1).mean())

    told = lean()
    monkeypatch.setattr(objective, "BALANCE_SPREAD", 1e6)
    assert told < 0.5 * lean()
