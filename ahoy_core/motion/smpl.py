"""Motions in the layouts of SMPL's family: AMASS archives and SMPL-X parameters (24, 52 or 55 joints).

Their bodies rest in a T-pose, y up, facing +z; AMASS worlds are z up. No licensed file is needed: what the retargeting
uses of the body are the directions of its bones at rest, and those of a T-pose are along the axes.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ahoy_core.body.convert import Skeleton, SkeletonPose
from ahoy_core.body.rotations import axis_angle_to_matrix
from ahoy_core.body.smpl_names import JOINT_NAMES, packaged_from_smpl
from ahoy_core.formats.errors import NpzError
from ahoy_core.formats.npz import load_npz
from ahoy_core.motion.clip import Clip

_BODY_PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19)
_FACE = ("jaw", "left_eye_smplhf", "right_eye_smplhf")
_RATES = ("mocap_framerate", "mocap_frame_rate")
HIP_HEIGHT = 0.93
"""Metres: of the pelvis joint of SMPL's average body above its soles."""
# SMPL's rest axes (y up, facing +z) -> ours (z up, facing -y); left stays +x.
SMPL_AXES = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]], dtype=torch.float64)
SMPL_PELVIS = (0.0, -0.23, 0.03)  # metres: the pelvis joint in SMPL's own rest space, which the translation is added to


def joint_names(count: int) -> tuple[str, ...]:
    """Names of the 22, 24, 52 or 55 joints of a layout of SMPL's family.

    Raises:
        ValueError: For another number.
    """
    layouts = {len(names): names for names in JOINT_NAMES.values()}
    layouts[len(_BODY_PARENTS)] = JOINT_NAMES["smpl"][: len(_BODY_PARENTS)]
    if count not in layouts:
        raise ValueError(f"expected 22, 24 (SMPL), 52 (SMPL-H) or 55 (SMPL-X) joints, got {count}; convert the motion")
    return layouts[count]


def _parent(name: str) -> str:
    """Parent of a joint beyond the body's 22."""
    if name in _FACE:
        return "head"
    side = name.split("_")[0]
    if name[-1] in "23":
        return name[:-1] + str(int(name[-1]) - 1)
    return f"{side}_wrist"


def smpl_skeleton(count: int) -> Skeleton:
    """The T-pose skeleton of a layout in our axes: directions of limbs are right, lengths are rough."""
    names = joint_names(count)
    parents = tuple(_BODY_PARENTS) + tuple(names.index(_parent(name)) for name in names[len(_BODY_PARENTS) :])
    rest: list[Tensor] = []
    for name, parent in zip(names, parents, strict=True):
        step = torch.tensor(_step(name), dtype=torch.float64)
        rest.append(step if parent < 0 else rest[parent] + step)
    return Skeleton(names, parents, torch.stack(rest), "smpl-t-pose")


def _step(name: str) -> tuple[float, float, float]:
    """From a joint's parent to the joint, metres, our axes."""
    side = 1.0 if name.startswith("left") else -1.0
    part = name.split("_")[-1]
    if part in ("hip", "collar"):
        return (0.07 * side, 0.0, -0.09 if part == "hip" else 0.1)
    if part in ("knee", "ankle"):
        return (0.02 * side if part == "knee" else -0.01 * side, 0.0, -0.39)
    if part == "foot":
        return (0.02 * side, -0.12, -0.06)
    if part in ("shoulder", "elbow", "wrist", "hand") or (part[-1] in "123" and name.startswith(("left", "right"))):
        return ({"shoulder": 0.12, "elbow": 0.26, "wrist": 0.25}.get(part, 0.05) * side, 0.0, 0.0)
    return {"pelvis": (0.0, 0.0, HIP_HEIGHT), "neck": (0.0, 0.0, 0.2)}.get(name, (0.0, 0.0, 0.12))


def read_smpl(path: str | Path, fps: float | None = None) -> Clip:
    """Read an AMASS archive (`poses`, `trans`) or SMPL-X parameters (`global_orient`, `body_pose`, ... `transl`).

    Args:
        path: The `.npz` file.
        fps: Frames per second, if the file does not say.

    Raises:
        FileNotFoundError: No such file.
        NpzError: Not a complete `.npz`, or without poses or rate.
    """
    source = Path(path)
    names = set(np.load(source, allow_pickle=False).files) if source.is_file() else set()
    wanted = names & {"poses", "trans", "transl", "global_orient", "body_pose", "jaw_pose", "leye_pose", "reye_pose",
                      "left_hand_pose", "right_hand_pose", "expression", *_RATES, "fps"}  # fmt: skip
    arrays = load_npz(source, wanted or None)
    poses = _poses(arrays, source.name)
    rates = [float(np.asarray(arrays[key]).reshape(-1)[0]) for key in (*_RATES, "fps") if key in arrays]
    rate = fps or (rates[0] if rates else None)
    if rate is None or not rate > 0:
        raise NpzError(f"expected a rate ({' or '.join(_RATES)}) in {source.name!r}, got none; give the rate yourself")
    trans = arrays.get("trans", arrays.get("transl", np.zeros((len(poses), 3))))
    if trans.shape != (len(poses), 3):
        raise NpzError(f"expected translations [{len(poses)},3] in {source.name!r}, got {list(trans.shape)}")
    notes = []
    if np.any(arrays.get("expression", 0)):
        notes.append("the recording's expression is of another face model and was left out")
    return _clip(source.stem, torch.from_numpy(poses), torch.from_numpy(trans.astype(np.float64)), rate, tuple(notes))


def _poses(arrays: Mapping[str, np.ndarray], name: str) -> np.ndarray:
    """[T,J,3] axis-angle, whichever layout the file has."""
    if "poses" in arrays:
        parts = [arrays["poses"]]
    elif "body_pose" in arrays:
        count = len(np.atleast_1d(arrays["body_pose"]))
        keys = ["global_orient", "body_pose"]
        hands = ["left_hand_pose", "right_hand_pose"]
        # Hands as coefficients of a licensed basis say nothing without that basis.
        if all(key in arrays and np.size(arrays[key]) == count * 45 for key in hands):
            keys += ["jaw_pose", "leye_pose", "reye_pose", *hands]
        parts = [np.reshape(arrays.get(key, np.zeros((count, 3))), (count, -1)) for key in keys]
    else:
        raise NpzError(f"expected 'poses' (AMASS) or 'body_pose' (SMPL-X) in {name!r}, got {sorted(arrays)}")
    flat = np.concatenate(parts, axis=-1).astype(np.float64)
    flat = flat.reshape(len(flat), -1)
    if flat.shape[1] % 3 or flat.shape[1] // 3 not in (22, 24, 52, 55):
        raise NpzError(f"expected 3 numbers for 22, 24, 52 or 55 joints in {name!r}, got {flat.shape[1]} a frame")
    return flat.reshape(len(flat), -1, 3)


def _clip(name: str, poses: Tensor, trans: Tensor, fps: float, notes: tuple[str, ...]) -> Clip:
    rotations = SMPL_AXES @ axis_angle_to_matrix(poses) @ SMPL_AXES.T
    # The root's rotation goes from SMPL's rest axes to the z-up world, so it is turned on one side only.
    rotations[:, 0] = axis_angle_to_matrix(poses[:, 0]) @ SMPL_AXES.T
    root = trans + torch.tensor(SMPL_PELVIS, dtype=torch.float64)
    skeleton = smpl_skeleton(poses.shape[1])
    return Clip(
        name, skeleton, SkeletonPose(rotations, root), fps, HIP_HEIGHT, packaged_from_smpl(skeleton.joint_names), notes
    )
