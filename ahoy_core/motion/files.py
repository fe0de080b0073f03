"""Any motion by one name: a built-in one, our own `.npz`, an AMASS or SMPL-X `.npz`, or a `.bvh`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ahoy_core.body.model import BodyModel
from ahoy_core.body.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from ahoy_core.formats.errors import NpzError
from ahoy_core.formats.npz import load_npz, save_npz
from ahoy_core.motion.bvh import read_bvh_clip
from ahoy_core.motion.clip import retarget
from ahoy_core.motion.motion import Motion
from ahoy_core.motion.procedural import turn, wave
from ahoy_core.motion.smpl import read_smpl
from ahoy_core.motion.time import held_where_missing, resampled
from ahoy_core.motion.walk import sit, standing_pose, walk

FORMAT = "ahoy motion 1"
# Seconds that a built-in motion takes unless told otherwise.
_SECONDS = {"turn": 4.0, "wave": 3.0, "walk": 4.0, "sit": 3.0, "still": 1.0}
BUILT_IN = tuple(_SECONDS)


def built_in(name: str, body: BodyModel, betas: Tensor, fps: float, frames: int | None = None) -> Motion:
    """A motion from a formula: turn, wave, walk, sit or still, standing on z = 0.

    Args:
        name: One of `BUILT_IN`.
        body: The body in use.
        betas: [S] its shape.
        fps: Frames per second.
        frames: How many; the motion's own length by default.

    Raises:
        ValueError: For another name.
    """
    if name not in BUILT_IN:
        raise ValueError(f"expected a motion among {', '.join(BUILT_IN)}, or a .npz or .bvh file, got {name!r}")
    count = max(1, round(_SECONDS[name] * fps)) if frames is None else frames
    if name in ("walk", "sit"):
        made: Callable[..., Motion] = {"walk": walk, "sit": sit}[name]
        return made(body, count, fps, betas)
    if name == "wave":
        return _grounded(wave(body, count, fps), body, betas)
    stands = turn(body, count, fps, standing_pose(body))
    if name == "still":
        stands = replace(stands, name="still", pose=stands.pose[:1].expand(count, -1, -1).clone())
    return _grounded(stands, body, betas)


def _grounded(motion: Motion, body: BodyModel, betas: Tensor) -> Motion:
    """The motion raised so that the soles are on z = 0 in its first frame."""
    lowest = body(motion.pose[:1], betas[None].to(motion.pose), motion.transl[:1]).vertices[0, :, 2].min()
    shift = motion.transl.new_tensor([0.0, 0.0, -float(lowest)])
    return replace(motion, transl=motion.transl + shift)


def load_motion(
    name: str, body: BodyModel, betas: Tensor, fps: float, frames: int | None = None, up: str | None = None
) -> Motion:
    """A motion of the body in use.

    Args:
        name: A built-in motion, or the path of a file.
        body: The body in use.
        betas: [S] its shape.
        fps: Frames per second wanted.
        frames: At most this many.
        up: Axis that is up in a `.bvh`.

    Raises:
        FileNotFoundError: No such file.
        ValueError: Neither a built-in motion nor a file that can be read.
    """
    path = Path(name)
    if path.suffix.lower() == ".bvh":
        motion = retarget(read_bvh_clip(path, up), body, betas, fps)
    elif path.suffix.lower() == ".npz":
        own = "format" in load_npz(path, ["format"] if _holds(path, "format") else [])
        motion = load_own(path, body, fps) if own else retarget(read_smpl(path), body, betas, fps)
    else:
        return built_in(name, body, betas, fps, frames)
    if frames is None or frames >= len(motion):
        return motion
    cut = slice(0, frames)
    expression = None if motion.expression is None else motion.expression[cut]
    return replace(motion, pose=motion.pose[cut], transl=motion.transl[cut], expression=expression)


def _holds(path: Path, name: str) -> bool:
    """Whether an archive has an array of this name; reading the others is left to who knows them."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            return name in getattr(archive, "files", ())
    except FileNotFoundError:
        raise
    except Exception as error:
        raise NpzError(f"expected a complete .npz of plain arrays, got {path.name!r} ({error})") from error


def save_motion(path: str | Path, motion: Motion, body: BodyModel) -> None:
    """Write a motion as our own `.npz`: pose, transl, fps, joint names, body, and the expression if there is one."""
    arrays = {
        "format": np.array(FORMAT),
        "body": np.array(body.name),
        "joint_names": np.array(body.joint_names),
        "pose": motion.pose.numpy().astype(np.float32),
        "transl": motion.transl.numpy().astype(np.float32),
        "fps": np.array(motion.fps, dtype=np.float64),
    }
    if motion.expression is not None:
        arrays |= {"expression": motion.expression.numpy().astype(np.float32)}
        arrays |= {"expression_names": np.array(body.expression_names)}
    save_npz(path, arrays)


def load_own(path: str | Path, body: BodyModel, fps: float) -> Motion:
    """Read what `save_motion` wrote, at another rate; joints and expressions go by their names.

    Raises:
        NpzError: Another format, or arrays that do not fit each other.
    """
    source = Path(path)
    arrays = load_npz(source)
    if str(arrays.get("format")) != FORMAT or not {"pose", "transl", "fps", "joint_names"} <= set(arrays):
        raise NpzError(f"expected {FORMAT!r} with pose, transl, fps and joint_names, got {sorted(arrays)}")
    names = [str(name) for name in arrays["joint_names"]]
    stored, transl, rate = arrays["pose"], arrays["transl"], float(arrays["fps"])
    if stored.shape != (len(transl), len(names), 3) or transl.shape != (len(stored), 3):
        raise NpzError(f"expected pose [T,{len(names)},3] and transl [T,3] in {source.name!r}, got {stored.shape}")
    pose = torch.zeros(len(stored), body.n_joints, 3)
    missing = [name for name in body.joint_names if name not in names]
    for number, name in enumerate(body.joint_names):
        if name in names:
            pose[:, number] = torch.from_numpy(stored[:, names.index(name)])
    rotations, root, notes = held_where_missing(axis_angle_to_matrix(pose), torch.from_numpy(transl))
    rotations, root = resampled(rotations, root, rate, fps)
    if missing:
        notes = (*notes, f"{len(missing)} joints missing from the recording stay at rest: {', '.join(missing[:5])}")
    expression = _expression(arrays, body, len(rotations), rate, fps)
    return Motion(source.stem, matrix_to_axis_angle(rotations), root.float(), fps, expression, notes)


def _expression(arrays: dict[str, np.ndarray], body: BodyModel, count: int, rate: float, fps: float) -> Tensor | None:
    if "expression" not in arrays:
        return None
    names = [str(name) for name in arrays.get("expression_names", np.array(body.expression_names))]
    stored = torch.nan_to_num(torch.from_numpy(arrays["expression"]).float())
    own = torch.zeros(len(stored), body.n_expressions)
    for number, name in enumerate(body.expression_names):
        if name in names:
            own[:, number] = stored[:, names.index(name)]
    moments = (torch.arange(count) * (rate / fps)).clamp(max=len(own) - 1)
    low = moments.floor().long()
    high = (low + 1).clamp(max=len(own) - 1)
    return torch.lerp(own[low], own[high], (moments - low)[:, None])
