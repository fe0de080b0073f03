from __future__ import annotations

import math

import pytest
import torch

from ahoy_core.body.canonical import canonical_pose
from ahoy_core.body.rotations import axis_angle_to_matrix, geodesic_distance
from ahoy_core.motion import Motion, replay, turn, wave
from ahoy_core.motion.procedural import MAX_JOINT_SPEED
from tests.avatar.scenes import body

FRAMES, FPS = 60, 15.0


def _speeds(motion: Motion) -> torch.Tensor:
    """[T-1,J] radians per second."""
    rotations = axis_angle_to_matrix(motion.pose.double())
    return geodesic_distance(rotations[:-1], rotations[1:]) * motion.fps


def _joints(motion: Motion) -> torch.Tensor:
    count = len(motion)
    return body()(motion.pose, body().default_betas.expand(count, -1), motion.transl).joints


def test_a_turn_shows_all_sides_at_constant_speed_and_loops():
    motion = turn(body(), FRAMES, FPS)
    speeds = _speeds(motion)
    assert torch.allclose(speeds[:, 0], torch.full((FRAMES - 1,), 2 * math.pi * FPS / FRAMES, dtype=torch.float64))
    assert float(speeds[:, 1:].max()) < 1e-6
    rotations = axis_angle_to_matrix(motion.pose[:, 0].double())
    step = rotations[1] @ rotations[0].T
    assert torch.allclose(step @ rotations[-1], rotations[0], atol=1e-6)


def test_a_turn_goes_to_the_persons_left_and_starts_in_front():
    motion = turn(body(), 4, FPS)
    forward = torch.tensor([0.0, -1.0, 0.0])
    faces = axis_angle_to_matrix(motion.pose[:, 0] - canonical_pose(body())[0]) @ forward
    assert torch.allclose(faces[0], forward, atol=1e-6)
    assert float(faces[1, 0]) > 0.99  # their left hand is towards +x


def test_a_turn_stays_in_place():
    joints = _joints(turn(body(), 8, FPS))
    assert float((joints[:, 0] - joints[0, 0]).norm(dim=1).max()) < 1e-5


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_wave_raises_the_hand_over_the_shoulder_and_only_that_one(side: str):
    joints = _joints(wave(body(), FRAMES, FPS, side=side))  # type: ignore[arg-type]
    names = body().joint_names
    letter, other = ("L", "R") if side == "left" else ("R", "L")
    hand, shoulder = names.index(f"wrist.{letter}"), names.index(f"upperarm01.{letter}")
    assert float(joints[FRAMES // 2, hand, 2]) > float(joints[FRAMES // 2, shoulder, 2]) + 0.1
    still = names.index(f"wrist.{other}")
    assert float((joints[:, still] - joints[0, still]).norm(dim=1).max()) < 1e-5


def test_a_wave_starts_and_ends_in_the_canonical_pose():
    motion = wave(body(), FRAMES, FPS)
    assert torch.allclose(motion.pose[0], canonical_pose(body()), atol=1e-5)
    assert torch.allclose(motion.pose[-1], canonical_pose(body()), atol=1e-5)


@pytest.mark.parametrize(("frames", "fps"), [(2, 15.0), (20, 15.0), (60, 15.0), (240, 30.0), (30, 30.0)])
def test_waves_of_any_length_stay_below_the_speed_limit(frames: int, fps: float):
    motion = wave(body(), frames, fps)
    assert float(_speeds(motion).max()) <= MAX_JOINT_SPEED
    assert torch.isfinite(motion.pose).all()


def test_a_wave_does_sway():
    names = body().joint_names
    joint = names.index("lowerarm01.R")
    motion = wave(body(), 240, 30.0)
    angle = motion.pose[:, joint, 1] - canonical_pose(body())[joint, 1]
    turns = int(((angle[2:] - angle[1:-1]).sign() != (angle[1:-1] - angle[:-2]).sign()).sum())
    assert turns >= 5


def test_one_frame_and_no_frame():
    assert len(wave(body(), 1, FPS)) == 1
    for make in (turn, wave):
        with pytest.raises(ValueError, match="at least one frame"):
            make(body(), 0, FPS)
        with pytest.raises(ValueError, match="positive rate"):
            make(body(), 3, 0.0)


def test_a_replay_leaves_out_unused_frames_and_refuses_broken_ones():
    pose = canonical_pose(body()).expand(3, -1, -1).clone()
    pose[1] = math.nan
    used = torch.tensor([True, False, True])
    assert len(replay(pose, torch.zeros(3, 3), FPS, used)) == 2
    with pytest.raises(ValueError, match="finite poses"):
        replay(pose, torch.zeros(3, 3), FPS)
    with pytest.raises(ValueError, match="at least one used frame"):
        replay(pose, torch.zeros(3, 3), FPS, torch.zeros(3, dtype=torch.bool))
