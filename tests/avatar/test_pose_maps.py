from __future__ import annotations

import math

import pytest
import torch

from ahoy_core.avatar.pose_maps import PoseMaps
from ahoy_core.avatar.pose_prior import PosePrior
from ahoy_core.body.canonical import canonical_pose
from ahoy_core.body.rotations import axis_angle_to_matrix, geodesic_distance, so3_exp
from tests.avatar.full_scenes import kinematics, raised
from tests.avatar.scenes import body, template


def _maps(reduction: int = 1) -> PoseMaps:
    return PoseMaps(template(), kinematics(), reduction)


def _rotations(angle: float = 0.5) -> torch.Tensor:
    return axis_angle_to_matrix(raised(angle))


def test_a_full_turn_and_a_tilt_give_identical_maps():
    pose = _rotations()
    maps = _maps()(pose[None])
    for axis in torch.eye(3):
        for angle in torch.linspace(0, 2 * math.pi, 5):
            turned = pose.clone()
            turned[0] = so3_exp(angle * axis) @ turned[0]
            assert torch.allclose(_maps()(turned[None]), maps, atol=1e-6)


def test_another_pose_gives_other_maps_where_it_moves_and_the_same_elsewhere():
    moved = (_maps().positions(_rotations()) - template().means).norm(dim=1)
    arm = template().means[:, 0] > 0.35  # left hand towards +x
    assert float(moved[arm].min()) > 0.05
    assert float(moved[template().means[:, 0] < -0.1].max()) < 1e-4


def test_the_canonical_pose_gives_the_canonical_maps():
    pose = axis_angle_to_matrix(canonical_pose(body()))
    assert torch.allclose(_maps()(pose[None]), template().maps(), atol=2e-5)  # a chain of some twenty products


def test_reduced_maps_hold_the_mean_of_each_block_and_are_read_back_by_it():
    maps = _maps(reduction=2)
    small = maps.reduce(template().maps())
    assert small.shape[-1] == template().map_size // 2
    side, row, column = template().pixels[100].tolist()
    same = (template().pixels // torch.tensor([1, 2, 2]) == torch.tensor([side, row // 2, column // 2])).all(1)
    values = template().gather(template().maps().reshape(1, 2, 7, template().map_size, template().map_size))
    assert torch.allclose(small[0, 7 * side : 7 * side + 7, row // 2, column // 2], values[same].mean(0), atol=1e-5)
    read = maps.gather(small.reshape(2, 7, maps.size, maps.size))
    assert torch.equal(read[100], small[0, 7 * side : 7 * side + 7, row // 2, column // 2])


def test_gradients_of_shared_pixels_repeat_bit_for_bit_on_several_threads():
    maps = _maps(reduction=4)
    generator = torch.Generator().manual_seed(0)
    read = torch.randn(len(template().means), 256, generator=generator)  # enough for PyTorch to share the work out
    values = torch.randn(2, 256, maps.size, maps.size, generator=generator, requires_grad=True)
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        found = [torch.autograd.grad((maps.gather(values) * read).sum(), values)[0] for _ in range(40)]
    finally:
        torch.set_num_threads(threads)
    assert all(torch.equal(one, found[0]) for one in found)


def test_projection_leaves_training_poses_and_what_lies_between_them():
    poses = torch.stack([_rotations(angle) for angle in (0.0, 0.4, 0.8)])
    prior = PosePrior.of(poses)
    for pose in poses:
        assert float(geodesic_distance(prior.project(pose), pose).max()) < 1e-3
    # On the chord between two rotations: within a third of a degree of the arc's own.
    assert float(geodesic_distance(prior.project(_rotations(0.6)), _rotations(0.6)).max()) < 6e-3


def test_projection_brings_a_wild_pose_near_the_training_poses_by_its_strength():
    poses = torch.stack([_rotations(angle) for angle in (0.0, 0.4, 0.8)])
    prior = PosePrior.of(poses)
    wild = _rotations(2.5)
    joint = body().joint_names.index("upperarm01.L")
    away = [
        float(geodesic_distance(prior.project(wild, s)[joint], _rotations(0.8)[joint])) for s in (0.0, 0.25, 0.5, 1.0)
    ]
    assert away[0] > away[1] > away[2] > away[3]
    assert away[3] < 0.02
    assert torch.equal(prior.project(wild, 0.0), wild)


def test_the_root_is_never_projected():
    prior = PosePrior.of(_rotations()[None])
    turned = _rotations()
    turned[0] = so3_exp(torch.tensor([0.3, 2.0, -1.0]))
    assert torch.equal(prior.project(turned)[0], turned[0])


@pytest.mark.parametrize("poses", [1, 2, 5])
def test_single_and_repeated_poses_have_no_axes_and_project_to_themselves(poses: int):
    prior = PosePrior.of(_rotations(0.3).expand(poses, -1, -1, -1))
    assert len(prior.axes) == 0
    assert float(geodesic_distance(prior.project(_rotations(1.5)), _rotations(0.3)).max()) < 1e-3


def test_rank_deficient_poses_keep_only_their_own_axes():
    poses = torch.stack([_rotations(angle) for angle in (0.0, 0.1, 0.1, 0.1, 0.2, 0.2)])
    assert 1 <= len(PosePrior.of(poses).axes) <= 2
    assert len(PosePrior.of(poses, components=0).axes) == 0


def test_no_pose_and_a_pose_with_nan_are_refused():
    with pytest.raises(ValueError, match="at least one finite training pose, got 0"):
        PosePrior.of(torch.zeros(0, body().n_joints, 3, 3))
    with pytest.raises(ValueError, match="finite"):
        PosePrior.of(torch.full((2, body().n_joints, 3, 3), math.nan))
    with pytest.raises(ValueError, match="strength"):
        PosePrior.of(_rotations()[None]).project(_rotations(), 1.5)
