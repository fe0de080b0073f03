"""Motions from `.bvh` files, whose joints have no standard names, units or up axis."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ahoy_core.body.convert import Skeleton, SkeletonPose
from ahoy_core.body.rotations import axis_angle_to_matrix
from ahoy_core.formats.bvh import Bvh, read_bvh
from ahoy_core.formats.errors import BvhError
from ahoy_core.motion.clip import Clip

# y up, facing +z (the usual) -> ours; z up, facing -y is ours already.
_UP = {
    "y": torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]], dtype=torch.float64),
    "z": torch.eye(3, dtype=torch.float64),
}
_AXES = {"X": 0, "Y": 1, "Z": 2}
# Joint of the packaged body -> the names that recording software gives it, without case, prefix and punctuation.
_SPINE = {
    "spine04": ("spine", "abdomen", "lowerback", "spine0", "torso"),
    "spine02": ("spine1", "chest", "abdomen2"),
    "spine01": ("spine2", "spine3", "chest2", "upperchest", "spine4"),
    "neck01": ("neck", "neck1", "neckbase"),
    "head": ("head",),
}
_SIDED = {
    "upperleg01": ("upleg", "thigh", "hip", "upperleg"),
    "lowerleg01": ("leg", "shin", "knee", "lowerleg", "lowleg", "calf"),
    "foot": ("foot", "ankle"),
    "clavicle": ("collar", "clavicle"),
    "upperarm01": ("arm", "upperarm", "uparm", "shldr"),
    "lowerarm01": ("forearm", "elbow", "lowerarm", "lowarm"),
    "wrist": ("hand", "wrist"),
}


def read_bvh_clip(path: str | Path, up: str | None = None) -> Clip:
    """Read a `.bvh` file as a clip.

    Lengths are scaled by the height of the hips later, so the file's unit does not matter. The rest pose is the one
    with all rotations zero.

    Args:
        path: The file.
        up: "y" or "z"; by default the axis along which the skeleton is tallest at rest.

    Raises:
        FileNotFoundError: No such file.
        BvhError: Malformed, or a skeleton without height.
    """
    source = Path(path)
    bvh = read_bvh(source)
    places = _rest(bvh)
    span = places.amax(0) - places.amin(0)
    axis = up or ("z" if span[2] > span[1] else "y")
    if axis not in _UP:
        raise BvhError(f"expected up 'y' or 'z', got {axis!r}")
    turn = _UP[axis]
    rest = places[: len(bvh.joints)] @ turn.T
    hip_height = float(rest[0, 2] - (places @ turn.T)[:, 2].min())
    if not hip_height > 0:
        raise BvhError(f"expected legs under the root in {source.name!r}, got none; say which axis is up")
    rotations = torch.stack([turn @ _rotation(bvh, joint) @ turn.T for joint in range(len(bvh.joints))], 1)
    root = torch.from_numpy(bvh.position(0)) @ turn.T
    names = tuple(joint.name for joint in bvh.joints)
    skeleton = Skeleton(names, tuple(joint.parent for joint in bvh.joints), rest, f"bvh-{source.stem}")
    notes = () if up else (f"the {axis} axis was taken as up",)
    joints = match_joints(names)
    return Clip(source.stem, skeleton, SkeletonPose(rotations, root), 1 / bvh.frame_time, hip_height, joints, notes)


def _rest(bvh: Bvh) -> Tensor:
    """Joints, then end sites, at rest [J+E,3] in the file's axes, the root's own offset left out."""
    places: list[np.ndarray] = []
    for joint in bvh.joints:
        places.append(np.zeros(3) if joint.parent < 0 else places[joint.parent] + np.asarray(joint.offset))
    places += [places[joint] + np.asarray(offset) for joint, offset in bvh.ends]
    return torch.from_numpy(np.stack(places))


def _rotation(bvh: Bvh, joint: int) -> Tensor:
    """[T,3,3]: the channels' rotations in the file's order, the first one outermost."""
    result = torch.eye(3, dtype=torch.float64).repeat(len(bvh.values), 1, 1)
    for axis, degrees in bvh.angles(joint):
        omega = torch.zeros(len(degrees), 3, dtype=torch.float64)
        omega[:, _AXES[axis]] = torch.from_numpy(np.deg2rad(degrees))
        result = result @ axis_angle_to_matrix(omega)
    return result


def _plain(name: str) -> str:
    """A joint's name without prefix, case and punctuation: "mixamorig:LeftUpLeg" -> "leftupleg"."""
    return re.sub(r"[^a-z0-9]", "", name.split(":")[-1].lower())


def match_joints(names: tuple[str, ...]) -> Mapping[str, str]:
    """Joint of the packaged body -> joint of the file, for those whose name is recognised; the roots always match."""
    plain = {_plain(name): name for name in reversed(names)}
    found = {"root": names[0]}
    for ours, choices in _SPINE.items():
        for choice in choices:
            if choice in plain and plain[choice] not in found.values():
                found[ours] = plain[choice]
                break
    for letter, side in (("L", "left"), ("R", "right")):
        sided = dict(_SIDED)
        # "Shoulder" is the collar bone where there is an arm beneath it, and the upper arm where there is a collar.
        has_arm = any(f"{prefix}{part}" in plain for prefix in (side, side[0]) for part in sided["upperarm01"])
        key = "clavicle" if has_arm else "upperarm01"
        sided[key] = (*sided[key], "shoulder")
        for ours, parts in sided.items():
            for part in parts:
                spellings = (side + part, side[0] + part, part + side, part + side[0])
                match = next((spelling for spelling in spellings if spelling in plain), None)
                if match and plain[match] not in found.values():
                    found[f"{ours}.{letter}"] = plain[match]
                    break
        if f"foot.{letter}" in found:
            toe = next((p for p in (f"{side}toebase", f"{side}toe", f"{side[0]}toe") if p in plain), None)
            found |= {f"toe{n}-1.{letter}": plain[toe] for n in range(1, 6)} if toe else {}
    return found
