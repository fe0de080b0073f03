"""AMASS, SMPL-X, BVH and our own files, against poses whose outcome is known without them."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from ahoy_core.body.convert import body_skeleton
from ahoy_core.body.packaged import load_packaged_body
from ahoy_core.formats.bvh import read_bvh
from ahoy_core.formats.errors import BvhError, NpzError
from ahoy_core.formats.npz import save_npz
from ahoy_core.motion import Motion, load_motion, save_motion, walk
from ahoy_core.motion.bvh import match_joints, read_bvh_clip
from ahoy_core.motion.legs import joints_of
from ahoy_core.motion.smpl import joint_names, read_smpl

BODY = load_packaged_body()
BETAS = BODY.default_betas
# SMPL's body stands along y; AMASS's worlds are z up, so a standing person's root is turned by a quarter about x.
UPRIGHT = [math.pi / 2, 0.0, 0.0]
# Directions are exact for limbs of one bone; the packaged arm bends a little between its two upper bones.
DEGREES = 6.0


def direction(motion: Motion, start: str, end: str) -> Tensor:
    rest = body_skeleton(BODY, BETAS).rest_joints
    joints = joints_of(BODY, motion.rotations(), rest, motion.transl)
    bone = joints[:, BODY.joint_names.index(end)] - joints[:, BODY.joint_names.index(start)]
    return torch.nn.functional.normalize(bone, dim=-1)


def angle(found: Tensor, wanted: list[float]) -> float:
    return math.degrees(math.acos(min(1.0, float((found * torch.tensor(wanted)).sum(-1).min()))))


def amass(path: Path, poses: np.ndarray, **extra: np.ndarray) -> Path:
    arrays = {
        "poses": poses.reshape(len(poses), -1),
        "trans": np.zeros((len(poses), 3)),
        "mocap_framerate": np.array(30.0),
    }
    save_npz(path, {**arrays, **extra})
    return path


def smpl_pose(joints: int = 52, **turned: list[float]) -> np.ndarray:
    pose = np.zeros((1, joints, 3))
    pose[0, 0] = UPRIGHT
    for name, omega in turned.items():
        pose[0, joint_names(joints).index(name)] = omega
    return pose


@pytest.mark.parametrize("joints", [22, 24, 52, 55])
def test_a_t_pose_of_every_layout_stands_upright_with_level_arms(tmp_path: Path, joints: int):
    motion = load_motion(str(amass(tmp_path / "t.npz", smpl_pose(joints))), BODY, BETAS, 30.0)
    assert len(motion) == 1
    assert angle(direction(motion, "upperarm01.L", "lowerarm01.L"), [1, 0, 0]) < DEGREES
    assert angle(direction(motion, "lowerarm01.R", "wrist.R"), [-1, 0, 0]) < DEGREES
    assert angle(direction(motion, "spine04", "head"), [0, 0, 1]) < 15.0
    assert angle(direction(motion, "upperleg01.L", "lowerleg01.L"), [0, 0, -1]) < DEGREES


def test_a_turned_root_turns_the_person_and_a_raised_arm_points_up(tmp_path: Path):
    # A quarter turn to the left about the vertical, then upright: the left arm points where -y's left was: to +y.
    root = (Rotation.from_euler("z", 90, degrees=True) * Rotation.from_rotvec(UPRIGHT)).as_rotvec()
    pose = smpl_pose(left_shoulder=[0.0, 0.0, math.pi / 2])
    pose[0, 0] = root
    motion = load_motion(str(amass(tmp_path / "a.npz", pose)), BODY, BETAS, 30.0)
    assert angle(direction(motion, "upperarm01.L", "lowerarm01.L"), [0, 0, 1]) < DEGREES
    assert angle(direction(motion, "upperarm01.R", "lowerarm01.R"), [0, -1, 0]) < DEGREES


def test_a_bent_elbow_and_knee_bend_the_way_smpl_bends_them(tmp_path: Path):
    # About SMPL's y, a negative angle swings the left forearm forward; about x, a positive one swings a shin back.
    pose = smpl_pose(left_elbow=[0.0, -math.pi / 2, 0.0], right_knee=[math.pi / 2, 0.0, 0.0])
    motion = load_motion(str(amass(tmp_path / "b.npz", pose)), BODY, BETAS, 30.0)
    assert angle(direction(motion, "lowerarm01.L", "wrist.L"), [0, -1, 0]) < DEGREES
    assert angle(direction(motion, "lowerleg01.R", "foot.R"), [0, 1, 0]) < DEGREES


@pytest.mark.parametrize("key", ["mocap_framerate", "mocap_frame_rate"])
def test_both_spellings_of_the_rate_are_read_and_a_thousand_a_second_keeps_its_speed(tmp_path: Path, key: str):
    poses = np.repeat(smpl_pose(), 1001, 0)
    trans = np.linspace([0, 0, 0.9], [0, -1, 0.9], 1001)  # a metre in a second
    save_npz(tmp_path / "fast.npz", {"poses": poses.reshape(1001, -1), "trans": trans, key: np.array(1000.0)})
    motion = load_motion(str(tmp_path / "fast.npz"), BODY, BETAS, 25.0)
    clip = read_smpl(tmp_path / "fast.npz")
    scale = float(body_skeleton(BODY, BETAS).rest_joints[0, 2] - body_skeleton(BODY, BETAS).rest_joints[:, 2].min())
    assert len(motion) == 26
    assert float(motion.transl[0, 1] - motion.transl[-1, 1]) == pytest.approx(scale / clip.hip_height, rel=1e-5)


def test_smplx_parameters_are_read_as_well_as_poses(tmp_path: Path):
    pose = smpl_pose(22, left_shoulder=[0.0, 0.0, 1.0])
    parts = {"global_orient": pose[:, 0], "body_pose": pose[:, 1:].reshape(1, -1), "transl": np.zeros((1, 3))}
    save_npz(tmp_path / "x.npz", {**parts, "fps": np.array(30.0), "expression": np.ones((1, 10))})
    one = load_motion(str(tmp_path / "x.npz"), BODY, BETAS, 30.0)
    other = load_motion(str(amass(tmp_path / "p.npz", pose)), BODY, BETAS, 30.0)
    assert torch.allclose(one.pose, other.pose, atol=1e-6)
    assert any("expression" in note for note in one.notes)


def test_frames_that_are_not_finite_are_interpolated_and_said(tmp_path: Path):
    poses = np.repeat(smpl_pose(), 5, 0)
    poses[:, 16, 2] = np.linspace(0, 1, 5)
    whole = load_motion(str(amass(tmp_path / "whole.npz", poses)), BODY, BETAS, 30.0)
    poses[2, 16] = np.nan
    holed = load_motion(str(amass(tmp_path / "holed.npz", poses)), BODY, BETAS, 30.0)
    assert torch.allclose(whole.pose, holed.pose, atol=1e-5)
    assert any("1 of 5 frames" in note for note in holed.notes) and not any("frames" in note for note in whole.notes)
    poses[:, 16] = np.nan
    with pytest.raises(ValueError, match="finite in some frame"):
        load_motion(str(amass(tmp_path / "never.npz", poses)), BODY, BETAS, 30.0)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"poses": np.zeros((2, 156))}, "rate"),
        ({"poses": np.zeros((2, 150)), "mocap_framerate": np.array(30.0)}, "22, 24, 52 or 55"),
        ({"trans": np.zeros((2, 3)), "mocap_framerate": np.array(30.0)}, "poses"),
        ({"poses": np.zeros((2, 156)), "trans": np.zeros((3, 3)), "fps": np.array(30.0)}, "translations"),
    ],
)
def test_incomplete_archives_say_what_is_missing(tmp_path: Path, arrays: dict[str, np.ndarray], message: str):
    save_npz(tmp_path / "bad.npz", arrays)
    with pytest.raises(NpzError, match=message):
        load_motion(str(tmp_path / "bad.npz"), BODY, BETAS, 30.0)


def test_a_cut_off_archive_is_refused(tmp_path: Path):
    path = amass(tmp_path / "cut.npz", smpl_pose())
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(NpzError, match="complete"):
        load_motion(str(path), BODY, BETAS, 30.0)


BVH = """HIERARCHY
ROOT Hips
{{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition {order}
  JOINT LeftUpLeg
  {{ OFFSET {hip} 0 0
    CHANNELS 3 {order}
    JOINT LeftLeg {{ OFFSET 0 -{thigh} 0 CHANNELS 3 {order}
      JOINT LeftFoot {{ OFFSET 0 -{thigh} 0 CHANNELS 3 {order} End Site {{ OFFSET 0 -{toe} {toe} }} }} }}
  }}
  JOINT LeftShoulder
  {{ OFFSET {hip} {thigh} 0 CHANNELS 3 {order}
    JOINT LeftArm {{ OFFSET {hip} 0 0 CHANNELS 3 {order}
      JOINT LeftForeArm {{ OFFSET {thigh} 0 0 CHANNELS 3 {order} End Site {{ OFFSET {thigh} 0 0 }} }} }}
  }}
}}
MOTION
Frames: {frames}
Frame Time: 0.008333333
{rows}
"""


def bvh_text(order: str = "ZXY", unit: float = 1.0, angles: tuple[float, ...] = (0, 0, 0), frames: int = 1) -> str:
    names = " ".join(f"{axis}rotation" for axis in order)
    sizes = {"hip": 0.1 * unit, "thigh": 0.4 * unit, "toe": 0.1 * unit}
    arm = " ".join(str(a) for a in angles)
    row = f"0 {0.9 * unit} {0.2 * unit} 0 0 0  0 0 0  0 0 0  0 0 0  0 0 0  {arm}  0 0 0"
    return BVH.format(order=names, frames=frames, rows="\n".join([row] * frames), **sizes)


@pytest.mark.parametrize("order", ["ZXY", "XYZ", "ZYX", "YZX"])
def test_bvh_rotations_are_applied_in_the_order_of_the_file(tmp_path: Path, order: str):
    path = tmp_path / "m.bvh"
    path.write_text(bvh_text(order, angles=(20.0, -35.0, 50.0)))
    clip = read_bvh_clip(path)
    arm = clip.skeleton.joint_names.index("LeftArm")
    # Capital letters are intrinsic rotations, which is what nested BVH channels mean; y up, +z forward becomes z up.
    wanted = Rotation.from_euler(order, [20.0, -35.0, 50.0], degrees=True).apply([1.0, 0.0, 0.0])
    found = clip.pose.rotations[0, arm] @ torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    assert np.allclose(found, [wanted[0], -wanted[2], wanted[1]], atol=1e-9)


def test_bvh_in_centimetres_and_in_metres_is_the_same_motion(tmp_path: Path):
    made = []
    for name, unit in (("m", 1.0), ("cm", 100.0), ("inch", 39.37)):
        (tmp_path / f"{name}.bvh").write_text(bvh_text(unit=unit, angles=(0, 0, 30.0), frames=3))
        made.append(load_motion(str(tmp_path / f"{name}.bvh"), BODY, BETAS, 120.0))
    for other in made[1:]:
        assert torch.allclose(made[0].rotations(), other.rotations(), atol=1e-5)
        assert torch.allclose(made[0].transl, other.transl, atol=1e-4)
    # 30 degrees about the file's y, which is up: the left arm swings back.
    back = [math.cos(math.radians(30)), math.sin(math.radians(30)), 0.0]
    assert angle(direction(made[0], "upperarm01.L", "lowerarm01.L"), back) < DEGREES
    assert any("joints" not in note and "axis" in note for note in made[0].notes)


def test_names_of_recording_software_find_their_joints():
    mixamo = ["Hips", "Spine", "LeftShoulder", "LeftArm", "LeftForeArm", "LeftHand", "LeftUpLeg", "LeftLeg", "LeftFoot"]
    found = match_joints(tuple(f"mixamorig:{name}" for name in mixamo))
    assert found["clavicle.L"].endswith("LeftShoulder") and found["upperarm01.L"].endswith("LeftArm")
    assert found["lowerleg01.L"].endswith("LeftLeg") and found["upperleg01.L"].endswith("LeftUpLeg")
    poser = match_joints(("hip", "lCollar", "lShldr", "lForeArm", "lHand", "lThigh", "lShin", "lFoot"))
    assert poser["clavicle.L"] == "lCollar" and poser["upperarm01.L"] == "lShldr" and poser["lowerleg01.L"] == "lShin"
    elbows = match_joints(("Hips", "LeftCollar", "LeftShoulder", "LeftElbow", "LeftWrist", "LeftHip", "LeftKnee"))
    assert elbows["upperarm01.L"] == "LeftShoulder" and elbows["lowerarm01.L"] == "LeftElbow"


@pytest.mark.parametrize("share", [0.1, 0.4, 0.6, 0.95])
def test_a_cut_off_bvh_is_refused(tmp_path: Path, share: float):
    text = bvh_text(frames=4)
    path = tmp_path / "cut.bvh"
    path.write_text(text[: int(share * len(text))])
    with pytest.raises(BvhError):
        read_bvh(path)


def test_a_bvh_without_known_joints_says_so(tmp_path: Path):
    path = tmp_path / "x.bvh"
    text = bvh_text()
    for word in ("UpLeg", "Shoulder", "Foot", "ForeArm", "Leg", "Arm"):
        text = text.replace(f"Left{word}", f"bone_{word[::-1]}")
    path.write_text(text)
    with pytest.raises(ValueError, match="expected joints of the body"):
        load_motion(str(path), BODY, BETAS, 30.0)


def test_our_own_file_returns_the_motion_whatever_the_order_of_joints(tmp_path: Path):
    motion = walk(BODY, 9, 12.0)
    expression = torch.rand(9, BODY.n_expressions, generator=torch.Generator().manual_seed(0))
    motion = Motion(motion.name, motion.pose, motion.transl, motion.fps, expression)
    save_motion(tmp_path / "own.npz", motion, BODY)
    back = load_motion(str(tmp_path / "own.npz"), BODY, BETAS, 12.0)
    assert torch.allclose(back.rotations(), motion.rotations(), atol=1e-5)
    assert torch.allclose(back.transl, motion.transl, atol=1e-6)
    assert back.expression is not None and torch.allclose(back.expression, expression, atol=1e-5)
    arrays = dict(np.load(tmp_path / "own.npz"))
    order = np.random.default_rng(0).permutation(BODY.n_joints)
    save_npz(
        tmp_path / "mixed.npz",
        {**arrays, "pose": arrays["pose"][:, order], "joint_names": arrays["joint_names"][order]},
    )
    assert torch.allclose(load_motion(str(tmp_path / "mixed.npz"), BODY, BETAS, 12.0).pose, back.pose, atol=1e-6)
    without = {**arrays, "pose": arrays["pose"][:, 1:], "joint_names": arrays["joint_names"][1:]}
    save_npz(tmp_path / "less.npz", without)
    assert any("root" in note for note in load_motion(str(tmp_path / "less.npz"), BODY, BETAS, 12.0).notes)


def test_a_name_that_is_neither_built_in_nor_a_file_is_refused():
    with pytest.raises(ValueError, match="turn, wave, walk"):
        load_motion("jump", BODY, BETAS, 30.0)
    with pytest.raises(FileNotFoundError):
        load_motion("nowhere.bvh", BODY, BETAS, 30.0)
    with pytest.raises(FileNotFoundError):
        load_motion("nowhere.npz", BODY, BETAS, 30.0)
