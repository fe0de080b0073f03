"""The canonical pose theta_* (paper, section 3.1): one A-like pose in which front and back see most of the surface."""

from __future__ import annotations

import math
from typing import Final

import torch
from torch import Tensor

from ahoy_core.body.lbs import local_rotations
from ahoy_core.body.model import BodyModel
from ahoy_core.body.rotations import matrix_to_axis_angle

ARM_ANGLE: Final = math.radians(45)  # of the arm below the horizontal
LEG_ANGLE: Final = math.radians(7)  # of the leg from the vertical, outwards: feet about as far apart as the shoulders
# Joint, and the joint that its bone points to, for one side: what the packaged body and the SMPL family call them; the
# first name that a body has is taken.
_ARM = (
    (("upperarm01.L", "left_shoulder"), ("lowerarm01.L", "left_elbow")),
    (("lowerarm01.L", "left_elbow"), ("wrist.L", "left_wrist")),
    (("wrist.L", "left_wrist"), ("finger3-1.L", "left_middle1", "left_hand")),
)
_LEG = (
    (("upperleg01.L", "left_hip"), ("lowerleg01.L", "left_knee")),
    (("lowerleg01.L", "left_knee"), ("foot.L", "left_ankle")),
)
_FOOT = (("foot.L", "left_ankle"), ("toe3-1.L", "left_foot"))


def canonical_pose(body: BodyModel) -> Tensor:
    """The canonical pose [J,3], axis-angle: standing upright, facing -y, straight arms 45 degrees down, feet flat.

    It is one constant pose of the body, made so that it is exact for the average adult (`default_betas`).

    Raises:
        ValueError: when the body's skeleton lacks the limbs' joints.
    """
    still = body.default_betas.new_zeros(1, body.n_joints, 3)
    rest = body(still, body.default_betas[None], still[:, 0]).rest_joints.detach().double().cpu()
    turns = torch.eye(3, dtype=torch.float64).repeat(body.n_joints, 1, 1)
    fixed: dict[int, Tensor] = {}
    for side, sign in (("L", 1.0), ("R", -1.0)):
        down = torch.tensor([sign * math.cos(ARM_ANGLE), 0.0, -math.sin(ARM_ANGLE)], dtype=torch.float64)
        leg = torch.tensor([sign * math.sin(LEG_ANGLE), 0.0, -math.cos(LEG_ANGLE)], dtype=torch.float64)
        for bones, direction in ((_ARM, down), (_LEG, leg)):
            for start, end in bones:
                a, b = _index(body, start, side), _index(body, end, side)
                fixed[a] = _rotation_between(rest[0, b] - rest[0, a], direction)
        foot, toes = (_index(body, names, side) for names in _FOOT)
        fixed[foot] = _forward(rest[0, toes] - rest[0, foot])
    for joint, parent in enumerate(body.parents):
        turns[joint] = fixed[joint] if joint in fixed else (turns[parent] if parent >= 0 else turns[joint])
    pose = matrix_to_axis_angle(local_rotations(turns[None], body.parents))[0]
    return pose.to(body.default_betas)


def canonical_transl(body: BodyModel, betas: Tensor | None = None) -> Tensor:
    """Translation [3] that puts the canonical body of a shape [S] upright over the origin with its soles on z = 0."""
    betas = body.default_betas if betas is None else betas
    output = body(canonical_pose(body)[None], betas[None], betas.new_zeros(1, 3))
    root = output.joints[0, 0]
    return torch.stack([-root[0], -root[1], -output.vertices[0, :, 2].min()]).detach()


def _index(body: BodyModel, names: tuple[str, ...], side: str) -> int:
    """The joint that a body has of some names, given for the left side; side "L" or "R"."""
    if side == "R":
        names = tuple(name.replace(".L", ".R").replace("left_", "right_") for name in names)
    for name in names:
        if name in body.joint_names:
            return body.joint_names.index(name)
    raise ValueError(f"expected a body with a joint {' or '.join(names)} for the canonical pose, got {body.name!r}")


def _rotation_between(a: Tensor, b: Tensor) -> Tensor:
    """The least rotation [3,3] that takes direction a [3] to direction b [3], which is less than a half turn away."""
    a, b = a / a.norm(), b / b.norm()
    v = torch.linalg.cross(a, b)
    x, y, z = v.tolist()
    K = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=a.dtype)
    return torch.eye(3, dtype=a.dtype) + K + K @ K / (1 + torch.dot(a, b))


def _forward(toes: Tensor) -> Tensor:
    """The turn about z [3,3] that makes a flat foot with toes in direction [3] point half way to straight ahead."""
    angle = 0.5 * math.atan2(-float(toes[0]), -float(toes[1]))
    c, s = math.cos(angle), math.sin(angle)
    return torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1.0]], dtype=torch.float64)
