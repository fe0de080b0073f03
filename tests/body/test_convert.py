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
    convert_body_pose,
    convert_pose,
    from_local_ref,
    joint_map,
    rig_skeleton,
    skeleton_joints,
    to_local_ref,
)
from ahoy_core.body.lbs import global_rotations
from ahoy_core.body.model import BodyModel
from ahoy_core.body.packaged import PackagedBody, load_packaged_body
from ahoy_core.body.rotations import axis_angle_to_matrix, geodesic_distance, matrix_to_axis_angle, so3_exp

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


def body_pose(body: BodyModel, count: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    rng = torch.Generator().manual_seed(seed)
    pose = 0.4 * torch.randn(count, body.n_joints, 3, generator=rng, dtype=torch.float64)
    return pose, torch.randn(count, 3, generator=rng, dtype=torch.float64)


def paired(there: BodyModel, here: BodyModel) -> list[int]:
    """Joints of `here` whose rotation survives a trip to `there` and back."""
    to, back = joint_map(there.joint_names, here.joint_names), joint_map(here.joint_names, there.joint_names)
    assert to is not None and back is not None
    return [j for j, name in enumerate(here.joint_names) if to.get(back.get(name, "")) == name or j == 0]


@pytest.mark.parametrize(
    ("here", "there"),
    [("smplx", "packaged"), ("smpl", "packaged"), ("smplh", "packaged"), ("smpl", "smplx"), ("smplh", "smplx")],
)
def test_poses_survive_the_trip_to_another_body_and_back(bodies64: dict[str, BodyModel], here: str, there: str) -> None:
    source, target = bodies64[here], bodies64[there]
    pose, transl = body_pose(source, 3)
    kept = paired(target, source)
    assert {source.joint_names[j] for j in range(22)} <= {source.joint_names[j] for j in kept}, "all of the body's 22"
    still = torch.ones(source.n_joints, dtype=torch.bool)
    still[kept] = False
    pose[:, still] = 0
    back, back_transl = convert_body_pose(target, source, *convert_body_pose(source, target, pose, transl))
    torch.testing.assert_close(axis_angle_to_matrix(back), axis_angle_to_matrix(pose), atol=1e-9, rtol=0)
    torch.testing.assert_close(back_transl, transl, atol=1e-12, rtol=0)


@pytest.mark.parametrize("there", ["smpl", "smplh", "smplx"])
def test_a_turn_of_the_whole_body_turns_the_converted_one_alike(bodies64: dict[str, BodyModel], there: str) -> None:
    """Through a full turn: axis-angle ends where it began, the rotation does not stutter on the way."""
    source, target = bodies64["packaged"], bodies64[there]
    pose, transl = body_pose(source, 1)
    angles = torch.linspace(0, 2 * torch.pi, 9, dtype=torch.float64)
    turns = axis_angle_to_matrix(torch.stack([0 * angles, 0 * angles, angles], dim=-1))
    turned = pose.expand(9, -1, -1).clone()
    turned[:, 0] = matrix_to_axis_angle(turns @ axis_angle_to_matrix(pose[:, 0]))
    got, place = convert_body_pose(source, target, turned, transl.expand(9, -1))
    still, _ = convert_body_pose(source, target, pose, transl)
    torch.testing.assert_close(axis_angle_to_matrix(got[:, 0]), turns @ axis_angle_to_matrix(still[:, 0]))
    others = axis_angle_to_matrix(got[:, 1:])
    torch.testing.assert_close(others, others[:1].expand_as(others), atol=1e-9, rtol=0)
    output, before = (
        target(got, target.default_betas[None], place),
        target(still, target.default_betas[None], place[:1]),
    )
    local, expected = (o.vertices - o.joints[:, :1] for o in (output, before))
    torch.testing.assert_close(local, expected @ turns.mT, atol=1e-9, rtol=0)


@pytest.mark.parametrize("there", ["smpl", "smplh", "smplx"])
def test_limbs_point_the_same_way_though_one_body_rests_with_raised_arms(
    bodies64: dict[str, BodyModel], there: str
) -> None:
    source, target = bodies64["packaged"], bodies64[there]
    pose, transl = body_pose(source, 4)
    for bone in ("upperleg02", "lowerleg02", "upperarm02", "lowerarm02", "shoulder01"):  # twist bones have no partner
        for side in "LR":
            pose[:, source.joint_names.index(f"{bone}.{side}")] = 0
    posed = source(pose, source.default_betas[None], transl).joints
    got = target(*_with_betas(target, convert_body_pose(source, target, pose, transl))).joints
    for side, letter in (("left", "L"), ("right", "R")):
        for (a, b), (c, d) in {
            ("upperarm01", "lowerarm01"): ("shoulder", "elbow"),
            ("lowerarm01", "wrist"): ("elbow", "wrist"),
            ("upperleg01", "lowerleg01"): ("hip", "knee"),
            ("lowerleg01", "foot"): ("knee", "ankle"),
        }.items():
            bone = (
                posed[:, source.joint_names.index(f"{b}.{letter}")]
                - posed[:, source.joint_names.index(f"{a}.{letter}")]
            )
            limb = got[:, target.joint_names.index(f"{side}_{d}")] - got[:, target.joint_names.index(f"{side}_{c}")]
            cosine = torch.nn.functional.cosine_similarity(bone, limb, dim=-1)
            torch.testing.assert_close(cosine, torch.ones_like(cosine), atol=1e-9, rtol=0)


def _with_betas(body: BodyModel, posed: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    return posed[0], body.default_betas[None], posed[1]


def test_the_trunk_and_the_feet_rest_as_they_do_and_hands_follow_the_forearm(bodies64: dict[str, BodyModel]) -> None:
    """The packaged body at rest (A-pose) is the SMPL-X body with its arms lowered, and nothing else turned."""
    source, target = bodies64["packaged"], bodies64["smplx"]
    zero = torch.zeros(1, source.n_joints, 3, dtype=torch.float64)
    pose, _ = convert_body_pose(source, target, zero, zero[:, 0])
    world = global_rotations(axis_angle_to_matrix(pose), target.parents)[0]
    eye = torch.eye(3, dtype=torch.float64)
    for name in ("pelvis", "spine1", "spine3", "head", "left_ankle", "right_foot", "left_collar"):
        torch.testing.assert_close(world[target.joint_names.index(name)], eye, atol=1e-9, rtol=0)
    arm, hand, finger = (world[target.joint_names.index(f"left_{part}")] for part in ("elbow", "wrist", "index3"))
    assert geodesic_distance(arm, eye) > 0.3
    torch.testing.assert_close(hand, arm, atol=1e-9, rtol=0)
    assert geodesic_distance(finger, eye) > 0.3
