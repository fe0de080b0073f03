"""Legs: where the ankles are, and the two-bone solution that puts them where they should be.

The knee stays in the plane that hip, knee and ankle already span, and the foot keeps its orientation in the world, so
that a small correction looks like the same step.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Literal

import torch
from torch import Tensor

from ahoy_core.body.lbs import forward_kinematics, global_rotations
from ahoy_core.body.model import BodyModel
from ahoy_core.body.rotations import axis_angle_to_matrix, matrix_to_axis_angle

# Hip, knee and ankle under the names of the packaged body and of SMPL-X.
_NAMES = {
    "left": (("upperleg01.L", "lowerleg01.L", "foot.L"), ("left_hip", "left_knee", "left_ankle")),
    "right": (("upperleg01.R", "lowerleg01.R", "foot.R"), ("right_hip", "right_knee", "right_ankle")),
}
SIDES: Final[tuple[Literal["left"], Literal["right"]]] = ("left", "right")
# Share of the leg's length that a solution may use: a fully straight knee has no direction to bend in.
_REACH = 0.999
_SMALL = 1e-9
# Of the thigh's length: a knee bent less than this is pulled towards bending forward.
_FORWARD = 0.12


@dataclass(frozen=True)
class Leg:
    """Joint numbers of one leg."""

    hip: int
    knee: int
    ankle: int


def legs_of(body: BodyModel) -> Mapping[str, Leg]:
    """Both legs of a body.

    Raises:
        ValueError: If the skeleton has no joints of known names for them.
    """
    found = {}
    for side, choices in _NAMES.items():
        for names in choices:
            if all(name in body.joint_names for name in names):
                found[side] = Leg(*(body.joint_names.index(name) for name in names))
                break
        else:
            raise ValueError(f"expected joints {choices[0]} in body {body.name!r}, got none; add their names to _NAMES")
    return found


def joints_of(body: BodyModel, rotations: Tensor, rest: Tensor, transl: Tensor) -> Tensor:
    """Joint positions [T,J,3] of poses given as rotations [T,J,3,3], world, metres; `rest` [J,3] is the shaped body."""
    transforms = forward_kinematics(rotations, rest[None].to(rotations), body.parents, transl)
    return (transforms[..., :3, :3] @ rest.to(rotations)[None, :, :, None])[..., 0] + transforms[..., :3, 3]


def reach_ankles(body: BodyModel, pose: Tensor, transl: Tensor, rest: Tensor, targets: Mapping[str, Tensor]) -> Tensor:
    """Poses whose ankles are at the targets, as far as the legs reach.

    Args:
        body: The body model.
        pose: [T,J,3] axis-angle.
        transl: [T,3] metres.
        rest: [J,3] joints of the shaped body at rest.
        targets: For each side to move: [T,3] ankle positions, world, metres.

    Returns:
        [T,J,3]; everything above the hips and the feet's orientation in the world stay.
    """
    rotations = axis_angle_to_matrix(pose)
    for side, target in targets.items():
        rotations = _reach(body, rotations, transl, rest, legs_of(body)[side], target.to(rotations))
    return matrix_to_axis_angle(rotations)


def _reach(body: BodyModel, rotations: Tensor, transl: Tensor, rest: Tensor, leg: Leg, target: Tensor) -> Tensor:
    world = global_rotations(rotations, body.parents)
    joints = joints_of(body, rotations, rest, transl)
    hip, knee, ankle = joints[:, leg.hip], joints[:, leg.knee], joints[:, leg.ankle]
    thigh, shin = (knee - hip).norm(dim=1), (ankle - knee).norm(dim=1)
    line = target - hip
    distance = line.norm(dim=1).clamp(min=_SMALL)
    length = torch.minimum(torch.maximum(distance, (thigh - shin).abs() / _REACH + _SMALL), _REACH * (thigh + shin))
    along = line / distance[:, None]
    before = torch.nn.functional.normalize(ankle - hip, dim=1)
    bend = _across(knee - hip, before)
    # A nearly straight leg has no bend of its own worth keeping: its knee goes forward, where the pelvis looks.
    bend = bend + _FORWARD * thigh[:, None] * _across(-world[:, 0, :, 1], before)
    bend = (_swing(before, along) @ bend[:, :, None])[:, :, 0]
    bend = torch.nn.functional.normalize(_across(bend, along), dim=1)
    cosine = (thigh**2 + length**2 - shin**2) / (2 * thigh * length)
    sine = (1 - cosine**2).clamp(min=0).sqrt()
    new_knee = hip + thigh[:, None] * (cosine[:, None] * along + sine[:, None] * bend)
    new_ankle = hip + length[:, None] * along
    turned = {
        leg.hip: _swing(knee - hip, new_knee - hip) @ world[:, leg.hip],
        leg.knee: _swing(ankle - knee, new_ankle - new_knee) @ world[:, leg.knee],
    }
    result = rotations.clone()
    result[:, leg.hip] = world[:, body.parents[leg.hip]].transpose(1, 2) @ turned[leg.hip]
    # Joints between hip and knee keep their own rotations, so the knee's parent moved along with the hip.
    moved = global_rotations(result, body.parents)
    result[:, leg.knee] = moved[:, body.parents[leg.knee]].transpose(1, 2) @ turned[leg.knee]
    moved = global_rotations(result, body.parents)
    result[:, leg.ankle] = moved[:, body.parents[leg.ankle]].transpose(1, 2) @ world[:, leg.ankle]
    return result


def _across(vectors: Tensor, along: Tensor) -> Tensor:
    """The part of vectors [T,3] that is perpendicular to unit directions [T,3]."""
    return vectors - (vectors * along).sum(1, keepdim=True) * along


def _swing(a: Tensor, b: Tensor) -> Tensor:
    """The least rotations [T,3,3] that take directions a [T,3] to b [T,3], less than a half turn away."""
    axis = torch.linalg.cross(a, b)
    sine, cosine = axis.norm(dim=1), (a * b).sum(1)
    unit = axis / sine.clamp(min=_SMALL)[:, None]
    return axis_angle_to_matrix(unit * torch.atan2(sine, cosine)[:, None])
