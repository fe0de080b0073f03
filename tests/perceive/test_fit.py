"""The fit finds bodies whose pose is known."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from ahoy_core.body.packaged import PackagedBody
from ahoy_core.perceive.fit import Fit, fit_body
from ahoy_core.perceive.objective import FitConfig
from ahoy_core.perceive.priors import RULES, build_prior
from tests.perceive.synthetic import PER_FRAME, Scene, make_scene, similarity_error, weighted

# Perfect landmarks; what is left is the pull of the priors. Twice what was measured.
BOUND_M = 0.012
MAIN = ("upperarm01", "lowerarm01", "wrist", "upperleg01", "lowerleg01", "foot")


def error(body: PackagedBody, scene: Scene, fit: Fit) -> float:
    rows = [body.joint_names.index(f"{name}.{side}") for name in MAIN for side in "LR"]
    joints = body(fit.pose, fit.betas[None], fit.transl).joints
    return float(similarity_error(joints[:, rows], scene.joints[:, rows]).mean())


@pytest.mark.parametrize("facing", [0.3, math.pi, -1.5])
def test_a_known_pose_is_recovered_whichever_way_the_person_faces(body: PackagedBody, facing: float) -> None:
    scene = make_scene(body, facing=facing)
    fit = fit_body(body, scene.seen, FitConfig())
    assert error(body, scene, fit) < BOUND_M
    assert float((fit.transl - scene.transl).norm(dim=-1).max()) < 0.1
    assert fit.image_error < 0.005


def test_a_landmark_of_weight_zero_has_no_influence(body: PackagedBody) -> None:
    scene = make_scene(body, frames=3)
    weights = scene.seen.weights.clone()
    weights[:, 15] = 0
    plain = fit_body(body, weighted(scene.seen, weights), FitConfig())
    points, world = scene.seen.points.clone(), scene.seen.world.clone()
    points[:, 15], world[:, 15] = 1e4, 50.0
    wild = fit_body(body, replace(weighted(scene.seen, weights), points=points, world=world), FitConfig())
    assert torch.equal(plain.pose, wild.pose)


def test_one_wildly_wrong_landmark_is_ignored(body: PackagedBody) -> None:
    scene = make_scene(body)
    points, world = scene.seen.points.clone(), scene.seen.world.clone()
    points[:, 27] += 200.0
    world[:, 27] += 2.0
    fit = fit_body(body, replace(scene.seen, points=points, world=world), FitConfig())
    assert error(body, scene, fit) < 2 * BOUND_M
    assert float(fit.landmark_confidence[:, 27].max()) < 0.01 < float(fit.landmark_confidence[:, 25].min())


def test_one_frame_is_enough(body: PackagedBody) -> None:
    scene = make_scene(body, frames=1)
    assert error(body, scene, fit_body(body, scene.seen, FitConfig())) < BOUND_M


def test_nothing_seen_at_all_stays_finite_and_near_standing(body: PackagedBody) -> None:
    scene = make_scene(body, frames=3)
    fit = fit_body(body, weighted(scene.seen, torch.zeros(3, 33)), FitConfig())
    assert all(bool(torch.isfinite(t).all()) for t in (fit.pose, fit.transl, fit.betas))
    assert float(fit.pose[:, 1:].norm(dim=-1).max()) < 1.2
    assert float(fit.landmark_confidence.max()) == 0


def test_a_cut_does_not_drag_one_shots_pose_into_the_other(body: PackagedBody) -> None:
    first, second = make_scene(body, 3, facing=0.3, fps=4), make_scene(body, 3, facing=2.5, fps=4)
    both = {k: torch.cat([getattr(first.seen, k), getattr(second.seen, k)]) for k in PER_FRAME}
    times = torch.tensor([0.0, 0.25, 0.5, 0.53, 0.78, 1.03])
    seen = replace(first.seen, **both, times=times, shot=torch.tensor([0, 0, 0, 1, 1, 1]))
    fit = fit_body(body, seen, FitConfig())
    scene = replace(first, joints=torch.cat([first.joints, second.joints]))
    assert error(body, scene, fit) < BOUND_M


def test_hidden_legs_stand(body: PackagedBody) -> None:
    scene = make_scene(body, frames=4)
    weights = scene.seen.weights.clone()
    weights[:, 25:] = 0
    fit = fit_body(body, weighted(scene.seen, weights), FitConfig())
    knees = [body.joint_names.index(f"lowerleg01.{side}") for side in "LR"]
    assert float((fit.pose[:, knees].norm(dim=-1) - RULES["knee"].bent).abs().max()) < 0.05


def test_no_frames_is_an_error_that_says_so(body: PackagedBody) -> None:
    seen = make_scene(body, 2).seen
    none = {k: getattr(seen, k)[:0] for k in (*PER_FRAME, "times", "shot")}
    with pytest.raises(ValueError, match="at least one frame"):
        fit_body(body, replace(seen, **none), FitConfig())


def test_bending_axes_bend_knees_back_and_elbows_forward(body: PackagedBody) -> None:
    prior = build_prior(body, body.default_betas)
    rest = body(torch.zeros(1, body.n_joints, 3), body.default_betas[None], torch.zeros(1, 3)).joints[0]
    for joint, end, forward in (("lowerleg01", "foot", -1), ("lowerarm01", "wrist", 1)):
        for side in "LR":
            row = body.joint_names.index(f"{joint}.{side}")
            far = body.joint_names.index(f"{end}.{side}")
            pose = torch.zeros(1, body.n_joints, 3)
            pose[0, row] = 0.5 * prior.axes[prior.free.index(row) - 1, 0]
            bent = body(pose, body.default_betas[None], torch.zeros(1, 3)).joints[0]
            assert forward * float(rest[far, 1] - bent[far, 1]) > 0.05
