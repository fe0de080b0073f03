"""Frames without a person get poses in between."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ahoy_core.perceive.timeline import joint_confidence, neighbours, ranges, spread_poses

USED = np.array([False, True, False, False, True, False])
PTS = np.array([0.0, 0.1, 0.2, 0.35, 0.4, 0.5])
ONE_SHOT = np.zeros(6, int)


def test_poses_between_turn_evenly_in_time_and_the_ends_are_held() -> None:
    pose = torch.zeros(2, 1, 3)
    pose[0, 0, 2], pose[1, 0, 2] = 0.2, 1.4
    transl = torch.tensor([[0.0, 1.0, 0.0], [3.0, 1.0, 0.0]])
    poses, places = spread_poses(pose, transl, USED, PTS, ONE_SHOT)
    np.testing.assert_allclose(poses[:, 0, 2], [0.2, 0.2, 0.6, 1.2, 1.4, 1.4], atol=1e-5)
    np.testing.assert_allclose(places[:, 0], [0, 0, 1, 2.5, 3, 3], atol=1e-5)


def test_a_turn_past_pi_takes_the_short_way() -> None:
    pose = torch.zeros(2, 1, 3)
    pose[0, 0, 2], pose[1, 0, 2] = 3.0, -3.0
    poses, _ = spread_poses(pose, torch.zeros(2, 3), np.array([True, False, True]), np.arange(3.0), np.zeros(3, int))
    assert abs(float(poses[1, 0].norm())) == pytest.approx(np.pi, abs=1e-3)


def test_a_frame_takes_its_pose_from_its_own_shot() -> None:
    before, after, _ = neighbours(USED, PTS, np.array([0, 0, 0, 1, 1, 1]))
    assert before.tolist() == [1, 1, 1, 4, 4, 4] and after.tolist() == before.tolist()


def test_joints_take_confidence_from_landmarks_near_them() -> None:
    landmarks = torch.zeros(33, 3)
    landmarks[:, 0] = torch.arange(33) * 1.0
    confidence = torch.zeros(1, 33)
    confidence[0, 5] = 1.0
    joints = torch.tensor([[5.02, 0.0, 0.0], [9.0, 0.0, 0.0]])
    np.testing.assert_allclose(joint_confidence(landmarks, joints, confidence), [[1.0, 0.0]], atol=1e-6)


def test_runs_are_listed_for_the_notes() -> None:
    assert ranges(np.array([True, True, False, True])) == [[0, 1], [3, 3]]
    assert ranges(np.zeros(3, bool)) == []
