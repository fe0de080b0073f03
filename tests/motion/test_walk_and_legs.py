"""Walking, sitting, and the legs under them: feet stay where they are put."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from ahoy_core.body.convert import body_skeleton
from ahoy_core.body.lbs import global_rotations
from ahoy_core.body.packaged import load_packaged_body
from ahoy_core.body.rotations import axis_angle_to_matrix, geodesic_distance
from ahoy_core.motion import Motion, placed, sit, walk
from ahoy_core.motion.legs import joints_of, legs_of, reach_ankles
from ahoy_core.motion.walk import STEP_RATE, standing_pose

BODY = load_packaged_body()
REST = body_skeleton(BODY).rest_joints
MILLIMETRE = 1e-3


def joints(motion: Motion) -> Tensor:
    return joints_of(BODY, motion.rotations(), REST, motion.transl)


def soles(motion: Motion) -> Tensor:
    """[T] lowest point of the body, metres."""
    betas = BODY.default_betas[None]
    return torch.stack(
        [BODY(p[None], betas, t[None]).vertices[0, :, 2].min() for p, t in zip(motion.pose, motion.transl, strict=True)]
    )


def test_a_walking_foot_is_still_while_it_is_down_and_moves_a_stride_while_it_is_up():
    fps = 60.0
    motion = walk(BODY, int(4 / STEP_RATE * fps), fps)
    for side in ("left", "right"):
        ankle = joints(motion)[:, legs_of(BODY)[side].ankle]
        down = ankle[:, 2] < ankle[:, 2].min() + 0.1 * MILLIMETRE
        both = down[1:] & down[:-1]
        assert float((ankle[1:] - ankle[:-1]).norm(dim=1)[both].max()) < 0.5 * MILLIMETRE
        assert 0.4 < float(down.float().mean()) < 0.75
        assert 0.03 < float(ankle[:, 2].max() - ankle[:, 2].min()) < 0.2
    travelled = motion.transl[0, 1] - motion.transl[-1, 1]
    assert 1.0 < float(travelled) < 2.0  # four steps of about 0.3 m, straight ahead
    assert float(soles(walk(BODY, 12, 10.0)).min()) > -12 * MILLIMETRE  # toes of a lifted, pitched foot dip a little


def test_sitting_keeps_the_feet_and_lowers_the_hips_to_the_seat():
    motion = sit(BODY, 30, 10.0, seat=0.5)
    places = joints(motion)
    legs = legs_of(BODY)
    for leg in legs.values():
        assert float((places[:, leg.ankle] - places[0, leg.ankle]).norm(dim=1).max()) < 2 * MILLIMETRE
    assert float(places[-1, legs["left"].hip, 2]) == pytest.approx(0.58, abs=0.01)
    knee = places[-1, legs["left"].knee] - places[-1, legs["left"].hip]
    assert float(knee[1]) < -0.25  # the knees are in front
    with pytest.raises(ValueError, match="seat"):
        sit(BODY, 10, 10.0, seat=1.5)


def test_ankles_reach_their_targets_and_feet_keep_their_orientation():
    pose = standing_pose(BODY)[None].repeat(3, 1, 1)
    transl = torch.zeros(3, 3)
    leg = legs_of(BODY)["left"]
    start = joints_of(BODY, axis_angle_to_matrix(pose), REST, transl)[:, leg.ankle]
    target = start + torch.tensor([[0.0, 0.0, 0.15], [0.1, -0.2, 0.2], [0.0, 0.3, 0.1]])
    moved = reach_ankles(BODY, pose, transl, REST, {"left": target})
    found = joints_of(BODY, axis_angle_to_matrix(moved), REST, transl)
    assert float((found[:, leg.ankle] - target).norm(dim=1).max()) < MILLIMETRE
    before, after = (global_rotations(axis_angle_to_matrix(p), BODY.parents)[:, leg.ankle] for p in (pose, moved))
    assert float(geodesic_distance(before, after).max()) < 1e-3
    other = legs_of(BODY)["right"].ankle
    assert torch.allclose(
        found[:, other], joints_of(BODY, axis_angle_to_matrix(pose), REST, transl)[:, other], atol=1e-5
    )


def test_a_target_out_of_reach_gives_a_straight_leg_towards_it():
    pose, transl = standing_pose(BODY)[None], torch.zeros(1, 3)
    leg = legs_of(BODY)["right"]
    hip = joints_of(BODY, axis_angle_to_matrix(pose), REST, transl)[0, leg.hip]
    for direction in (torch.tensor([0.0, -2.0, -2.0]), torch.tensor([0.0, 0.0, -3.0])):
        moved = reach_ankles(BODY, pose, transl, REST, {"right": (hip + direction)[None]})
        assert torch.isfinite(moved).all()
        found = joints_of(BODY, axis_angle_to_matrix(moved), REST, transl)[0, leg.ankle] - hip
        assert float(torch.nn.functional.cosine_similarity(found, direction, dim=0)) > 0.999
    at_hip = reach_ankles(BODY, pose, transl, REST, {"right": hip[None]})
    assert torch.isfinite(at_hip).all()


def test_placing_carries_the_start_and_turns_the_path():
    motion = walk(BODY, 20, 10.0)
    there = placed(motion, torch.tensor([3.0, 4.0, 0.5]), torch.pi / 2, REST[0])
    root = there.transl + REST[0]
    assert torch.allclose(root[0, :2], torch.tensor([3.0, 4.0]), atol=1e-6)
    # Facing -y and turned a quarter to the left, a walk goes along +x.
    step = root[-1] - root[0]
    assert float(step[0]) > 0.5 and abs(float(step[1])) < 1e-5
    assert torch.allclose(there.transl[:, 2], motion.transl[:, 2] + 0.5, atol=1e-6)
    one = joints(motion)[7] - joints(motion)[7, 0]
    other = joints(there)[7] - joints(there)[7, 0]
    turn = axis_angle_to_matrix(torch.tensor([0.0, 0.0, torch.pi / 2]))
    assert torch.allclose(one @ turn.T, other, atol=1e-5)
