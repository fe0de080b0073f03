"""Poses across bodies: the captures' 163 bones, and skeletons with another rest pose."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from ahoy_core.body.convert import (
    Skeleton,
    SkeletonPose,
    body_skeleton,
    convert_pose,
    from_local_ref,
    rig_skeleton,
    skeleton_joints,
    to_local_ref,
)
from ahoy_core.body.packaged import PackagedBody, load_packaged_body
from ahoy_core.body.rotations import axis_angle_to_matrix, so3_exp

GOLDEN = Path(__file__).with_name("golden_captures.npz")
MILLIMETRE = 1e-3
# Joints of the captures' README (SMPL's order) that are bone heads of the rig under these names.
JOINTS24 = {"pelvis": "root", "l_knee": "lowerleg01.L", "r_wrist": "wrist.R", "head": "head", "l_foot": "toe1-1.L"}


@pytest.fixture(scope="module")
def body() -> PackagedBody:
    return load_packaged_body()


def phenotype(body: PackagedBody, text: str) -> Tensor:
    values = json.loads(text)
    return torch.tensor([values[name] for name in body.beta_names])


def posed_joints(body: PackagedBody, motion: dict[str, np.ndarray]) -> Tensor:
    assert tuple(motion["bone_names"]) == body.rig_names
    betas = phenotype(body, str(motion["phenotype"]))
    pose, transl = from_local_ref(body, torch.from_numpy(motion["pose_local_ref"]), betas)
    return body(pose, betas[None], transl).joints


def assert_joints_match(body: PackagedBody, motion: dict[str, np.ndarray]) -> None:
    joints = posed_joints(body, motion)
    kept = [body.rig_names.index(name) for name in body.joint_names]
    heads = torch.from_numpy(motion["bone_heads_world"][:, kept])
    assert (joints - heads).norm(dim=-1).max() < MILLIMETRE
    for name, bone in JOINTS24.items():
        there = torch.from_numpy(motion["joints24"][:, list(motion["joints24_names"]).index(name)])
        assert (joints[:, body.joint_names.index(bone)] - there).norm(dim=-1).max() < MILLIMETRE, name


@pytest.mark.parametrize("capture", ["a", "b"])
def test_joints_of_capture_frames_are_within_a_millimetre(body: PackagedBody, capture: str) -> None:
    with np.load(GOLDEN) as golden:
        assert_joints_match(body, {k[2:]: golden[k] for k in golden.files if k.startswith(capture)})


@pytest.mark.shared
@pytest.mark.parametrize("name", ["a/motion.npz", "a/novel_motion.npz", "b/motion.npz", "b/novel_motion.npz"])
def test_joints_of_all_capture_frames_are_within_a_millimetre(body: PackagedBody, shared_dir: Path, name: str) -> None:
    with np.load(shared_dir / "captures" / name) as motion:
        assert_joints_match(body, {k: motion[k] for k in motion.files})


def test_captures_survive_the_round_trip(body: PackagedBody) -> None:
    with np.load(GOLDEN) as golden:
        there = torch.from_numpy(golden["a_pose_local_ref"])
        betas = phenotype(body, str(golden["a_phenotype"]))
    back = to_local_ref(body, *from_local_ref(body, there, betas), betas)
    torch.testing.assert_close(back, there, atol=1e-5, rtol=0)


def test_a_bone_without_a_joint_passes_its_turn_on(body: PackagedBody) -> None:
    """special05.L and special06.L hang between head and eye: their rotation has to reach the eye."""
    rig = rig_skeleton(body)
    rotations = torch.eye(3).repeat(1, len(rig.parents), 1, 1)
    turn = so3_exp(torch.tensor([0.0, 0.0, 0.4]))
    rotations[:, rig.joint_names.index("special06.L")] = turn
    out = convert_pose(rig, body_skeleton(body), SkeletonPose(rotations, torch.zeros(1, 3)))
    torch.testing.assert_close(out.rotations[0, body.joint_names.index("eye.L")], turn, atol=1e-6, rtol=0)
    torch.testing.assert_close(out.rotations[0, body.joint_names.index("head")], torch.eye(3), atol=1e-6, rtol=0)


def test_a_skeleton_resting_in_another_pose_ends_with_the_same_bones() -> None:
    """A chain that rests straight down, and the same chain resting sideways, posed alike."""
    names, parents = ("root", "a", "b", "c"), (-1, 0, 1, 2)
    down = torch.tensor([[0, 0, 0], [0, 0, -1.0], [0, 0, -2], [0, 0, -3]])
    sideways = torch.tensor([[0, 0, 0], [0, 0, -1.0], [1, 0, -1], [2, 0, -1]])
    source, target = Skeleton(names, parents, sideways, "T"), Skeleton(names, parents, down, "I")
    rng = torch.Generator().manual_seed(0)
    rotations = axis_angle_to_matrix(torch.randn(5, 4, 3, generator=rng))
    posed = SkeletonPose(rotations, torch.randn(5, 3, generator=rng))
    got = skeleton_joints(target, convert_pose(source, target, posed))
    torch.testing.assert_close(got, skeleton_joints(source, posed), atol=1e-5, rtol=0)


def test_opposite_rest_bones_are_swung_by_a_half_turn() -> None:
    names, parents = ("root", "a", "b"), (-1, 0, 1)
    up, down = torch.tensor([[0, 0, 0], [0, 0, 1.0], [0, 0, 2]]), torch.tensor([[0, 0, 0], [0, 0, 1.0], [0, 0, 0]])
    source, target = Skeleton(names, parents, up, "up"), Skeleton(names, parents, down, "down")
    still = SkeletonPose(torch.eye(3).repeat(1, 3, 1, 1), torch.zeros(1, 3))
    torch.testing.assert_close(skeleton_joints(target, convert_pose(source, target, still))[0], up, atol=1e-5, rtol=0)


def test_joints_of_other_names_are_mapped() -> None:
    parents, rest = (-1, 0), torch.zeros(2, 3)
    source, target = Skeleton(("hips", "Knee"), parents, rest, "x"), Skeleton(("pelvis", "knee"), parents, rest, "x")
    rotations = axis_angle_to_matrix(torch.tensor([[[0.1, 0, 0], [0, 0.7, 0]]]))
    posed = SkeletonPose(rotations, torch.ones(1, 3))
    torch.testing.assert_close(convert_pose(source, target, posed, {"knee": "Knee"}).rotations, rotations)
    alone = convert_pose(source, target, posed).rotations
    torch.testing.assert_close(alone[:, 0], rotations[:, 0])
    torch.testing.assert_close(alone[0, 1], torch.eye(3))
    with pytest.raises(ValueError, match="mapping's direction"):
        convert_pose(source, target, posed, {"Knee": "knee"})


def test_translated_bones_and_other_rigs_are_refused(body: PackagedBody) -> None:
    pose = torch.eye(4).repeat(2, 163, 1, 1)
    pose[0, 5, 0, 3] = 0.01
    with pytest.raises(ValueError, match="only rotate"):
        from_local_ref(body, pose, body.default_betas)
    with pytest.raises(ValueError, match=r"\[T,163,4,4\]"):
        from_local_ref(body, pose[:, :104], body.default_betas)
