"""Sampling by the clock, and poses kept near the training poses."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from ahoy_core.body.packaged import load_packaged_body
from ahoy_core.body.rotations import axis_angle_to_matrix, geodesic_distance
from ahoy_core.motion import Motion, fit_pose_pca, project_pose, projected_motion, walk
from ahoy_core.motion.time import held_where_missing, resampled, slerp

BODY = load_packaged_body()


def spin(frames: int, rate: float, speed: float = 3.0) -> Tensor:
    """One joint at constant angular speed about an odd axis, past half turns: [T,1,3,3]."""
    axis = torch.nn.functional.normalize(torch.tensor([1.0, 2.0, -0.5], dtype=torch.float64), dim=0)
    return axis_angle_to_matrix(axis * (torch.arange(frames, dtype=torch.float64) / rate * speed)[:, None])[:, None]


@pytest.mark.parametrize(("rate", "wanted"), [(1000.0, 24.0), (24.0, 1000.0), (30.0, 30.0), (59.94, 25.0)])
def test_constant_speed_stays_exact_at_any_rate(rate: float, wanted: float):
    frames = int(2 * rate)
    place = torch.arange(frames, dtype=torch.float64)[:, None].expand(-1, 3) / rate
    turned, root = resampled(spin(frames, rate), place, rate, wanted)
    truth = spin(len(turned), wanted)
    # Beyond a slerp's rounding there is no error: the true motion is a slerp. acos of a float64 trace is 1e-8 at best.
    assert float(geodesic_distance(turned, truth).max()) < 1e-6
    assert torch.allclose(root[:, 0], torch.arange(len(root), dtype=torch.float64) / wanted, atol=1e-9)


def test_one_frame_stays_one_and_bad_rates_are_refused():
    turned, root = resampled(spin(1, 30.0), torch.ones(1, 3), 30.0, 1000.0)
    assert len(turned) == len(root) == 1
    for bad in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(ValueError, match="positive rates"):
            resampled(spin(2, 30.0), torch.ones(2, 3), 30.0, bad)


def test_slerp_takes_the_short_way_and_is_finite_between_equal_rotations():
    a, b = spin(3, 1.0, 0.0)[:1, 0], spin(3, 1.0, 2.5)[1:2, 0]
    half = slerp(a, b, torch.tensor([0.5]))
    assert float(geodesic_distance(a, half)) == pytest.approx(1.25, abs=1e-6)
    assert torch.isfinite(slerp(a, a, torch.tensor([0.3]))).all()


def test_gaps_at_the_ends_are_held_and_whole_recordings_are_left_alone():
    rotations, root = spin(6, 10.0), torch.arange(6.0)[:, None].expand(-1, 3).clone()
    same = held_where_missing(rotations, root)
    assert same[0] is rotations and same[1] is root and same[2] == ()
    holed = rotations.clone()
    holed[[0, 3, 5]] = torch.nan
    root[5] = torch.inf
    filled, place, notes = held_where_missing(holed, root)
    assert torch.allclose(filled[0], rotations[1]) and torch.allclose(filled[5], rotations[4])
    assert float(geodesic_distance(filled[3], rotations[3]).max()) < 1e-6
    assert torch.equal(place[5], place[4]) and "3 of 6" in notes[0]
    with pytest.raises(ValueError, match="at least one frame"):
        held_where_missing(rotations[:0], root[:0])


def training(count: int) -> Tensor:
    return walk(BODY, count, 12.0).pose


def apart(one: Tensor, other: Tensor) -> Tensor:
    """[T,J-1] angles between two sets of poses, without the root."""
    return geodesic_distance(axis_angle_to_matrix(one)[:, 1:], axis_angle_to_matrix(other)[:, 1:])


def far_pose() -> Tensor:
    g = torch.Generator().manual_seed(3)
    return torch.randn(4, BODY.n_joints, 3, generator=g)


def test_poses_of_the_span_within_the_bound_stay():
    poses = training(30)
    near = project_pose(fit_pose_pca(poses, 60), poses, 1.0, max_deviations=4.0)
    moved = geodesic_distance(axis_angle_to_matrix(near), axis_angle_to_matrix(poses))
    assert float(moved.max()) < math.radians(0.1)  # a walk has 29 directions; the last of them carry what is lost


def test_strength_moves_a_pose_steadily_from_itself_into_the_span():
    pca, pose = fit_pose_pca(training(30)), far_pose()
    assert project_pose(pca, pose, 0.0) is pose
    end = project_pose(pca, pose, 1.0)
    again = project_pose(pca, end, 1.0, max_deviations=1e6)
    left, whole = (
        geodesic_distance(*(axis_angle_to_matrix(p)[:, 1:] for p in pair)).mean()
        for pair in ((end, again), (pose, end))
    )
    assert float(left) < 0.02 * float(whole)  # what re-orthogonalising the columns takes out of the span again
    reached = [apart(pose, project_pose(pca, pose, strength)) for strength in (0.25, 0.5, 1.0)]
    # Along the shortest rotation, the angle covered is the strength times the whole.
    assert torch.allclose(reached[0] * 4, reached[2], atol=2e-3) and torch.allclose(
        reached[1] * 2, reached[2], atol=2e-3
    )


@pytest.mark.parametrize("poses", [training(1), training(1).expand(7, -1, -1), training(2)])
def test_sets_of_one_pose_or_of_low_rank_give_finite_poses(poses: Tensor):
    pca = fit_pose_pca(poses)
    assert len(pca.components) == len(torch.unique(poses, dim=0)) - 1
    end = project_pose(pca, far_pose(), 1.0)
    assert torch.isfinite(end).all()
    if not len(pca.components):
        found = axis_angle_to_matrix(end)[:, 1:]
        assert torch.allclose(found, axis_angle_to_matrix(poses[:1])[:, 1:].expand_as(found), atol=1e-4)


def test_which_way_a_person_faces_is_left_alone_and_the_pull_is_told_a_frame():
    pose = far_pose()
    motion, pull = projected_motion(Motion("m", pose, torch.zeros(4, 3), 10.0), training(12), 0.7)
    root = axis_angle_to_matrix(motion.pose[:, 0]), axis_angle_to_matrix(pose[:, 0])
    assert torch.allclose(*root, atol=1e-5)
    assert pull.shape == (4,) and float(pull.min()) > 0.1


def test_half_turns_do_not_tear_the_representation():
    """Axis-angle flips sign at a half turn: two poses a hair apart on either side of it must stay a hair apart."""
    pose = training(1).repeat(2, 1, 1)
    pose[0, 5], pose[1, 5] = torch.tensor([math.pi - 1e-3, 0, 0]), torch.tensor([-math.pi + 1e-3, 0, 0])
    pca = fit_pose_pca(training(12))
    one, two = axis_angle_to_matrix(project_pose(pca, pose, 1.0))[:, 1:]
    mean = fit_pose_pca(pose)
    assert float(geodesic_distance(one, two).max()) < 0.02
    assert float(mean.deviations.max()) < 0.01


@pytest.mark.parametrize(("strength", "bound"), [(-0.1, 2.0), (1.1, 2.0), (1.0, 0.0)])
def test_bad_knobs_are_refused(strength: float, bound: float):
    with pytest.raises(ValueError, match="strength"):
        project_pose(fit_pose_pca(training(3)), far_pose(), strength, bound)


def test_bad_training_poses_are_refused():
    for bad in (training(1)[:0], training(1) * math.nan):
        with pytest.raises(ValueError, match="training poses"):
            fit_pose_pca(bad)
