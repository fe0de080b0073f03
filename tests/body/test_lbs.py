"""Skinning and forward kinematics."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from ahoy_core.body.lbs import (
    blend_transforms,
    depth_levels,
    forward_kinematics,
    global_rotations,
    lbs,
    local_rotations,
)
from ahoy_core.body.rotations import axis_angle_to_matrix

PARENTS = (-1, 0, 0, 1, 3, 2)


def sample(batch: int = 2) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    rng = torch.Generator().manual_seed(0)
    pose = torch.randn(batch, 6, 3, generator=rng, dtype=torch.float64)
    rest = torch.randn(batch, 6, 3, generator=rng, dtype=torch.float64)
    transl = torch.randn(batch, 3, generator=rng, dtype=torch.float64)
    points = torch.randn(batch, 7, 3, generator=rng, dtype=torch.float64)
    weights = torch.rand(7, 6, generator=rng, dtype=torch.float64)
    return pose, rest, transl, points, weights / weights.sum(1, keepdim=True)


def test_kinematics_agree_with_one_matrix_product_a_joint() -> None:
    pose, rest, transl, _, _ = sample()
    rotations = axis_angle_to_matrix(pose)
    got = forward_kinematics(rotations, rest, PARENTS, transl)
    for b in range(2):
        world: list[Tensor] = []
        for j, parent in enumerate(PARENTS):
            local = torch.eye(4, dtype=torch.float64)
            local[:3, :3] = rotations[b, j]
            local[:3, 3] = rest[b, j] - (rest[b, parent] if parent >= 0 else -transl[b])
            world.append(world[parent] @ local if parent >= 0 else local)
            undo = torch.eye(4, dtype=torch.float64)
            undo[:3, 3] = -rest[b, j]
            torch.testing.assert_close(got[b, j], world[j] @ undo)


def test_identity_rotations_give_identity_transforms() -> None:
    _, rest, transl, _, _ = sample()
    eye = torch.eye(3, dtype=torch.float64).expand(2, 6, 3, 3)
    got = forward_kinematics(eye, rest, PARENTS, torch.zeros_like(transl))
    torch.testing.assert_close(got, torch.eye(4, dtype=torch.float64).expand(2, 6, 4, 4), atol=1e-15, rtol=0)


def test_local_rotations_undo_global_rotations() -> None:
    rotations = axis_angle_to_matrix(sample()[0])
    torch.testing.assert_close(local_rotations(global_rotations(rotations, PARENTS), PARENTS), rotations)


def test_skinning_is_the_blended_transform_applied() -> None:
    pose, rest, transl, points, weights = sample()
    transforms = forward_kinematics(axis_angle_to_matrix(pose), rest, PARENTS, transl)
    blended = blend_transforms(weights, transforms)
    homogeneous = torch.cat([points, torch.ones_like(points[..., :1])], dim=-1)
    expected = (blended @ homogeneous[..., None])[..., 0]
    torch.testing.assert_close(lbs(points, weights, transforms), expected[..., :3])
    torch.testing.assert_close(expected[..., 3], torch.ones_like(expected[..., 3]))
    per_pose = weights.expand(2, -1, -1)
    torch.testing.assert_close(lbs(points, per_pose, transforms), expected[..., :3])


def test_kinematics_and_skinning_pass_gradcheck_at_rest_and_at_a_half_turn() -> None:
    pose, rest, transl, points, weights = sample()
    pose[0] = 0
    pose[1, 0] = torch.tensor([0, 0, torch.pi])

    def skinned(*arguments: Tensor) -> Tensor:
        p, r, t, x, w = arguments
        return lbs(x, w, forward_kinematics(axis_angle_to_matrix(p), r, PARENTS, t))

    inputs = tuple(x.clone().requires_grad_() for x in (pose, rest, transl, points, weights))
    assert torch.autograd.gradcheck(skinned, inputs)


def test_parents_after_children_are_refused() -> None:
    with pytest.raises(ValueError, match="parents before children"):
        depth_levels((-1, 2, 0))
    with pytest.raises(ValueError, match="one root"):
        depth_levels((-1, -1))


def test_weights_of_another_body_are_refused() -> None:
    with pytest.raises(ValueError, match="one J"):
        blend_transforms(torch.ones(4, 5), torch.eye(4).expand(1, 6, 4, 4))
