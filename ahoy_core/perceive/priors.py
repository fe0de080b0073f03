"""Which joints the fit moves, where they tend to be, and how far they go.

Angles are components of the rotation vector in three anatomical axes of each joint: `bend` (flexion positive), `twist` (about the bone) and
`side`. The axes come from the rest skeleton, so the table below holds for any body whose rest pose stands and faces -y.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ahoy_core.body.model import BodyModel

FORWARD = (0.0, -1.0, 0.0)
BACKWARD = (0.0, 1.0, 0.0)


@dataclass(frozen=True)
class JointRule:
    """One moving joint, for both sides where `names` hold `{side}`.

    Attributes:
        names: what bodies call it, and the joint at the far end of its bone.
        flexes: world direction (rest pose) that the far end moves to when the joint bends.
        spread: standard deviation in radians about bend, twist and side.
        low: lowest angle about bend, twist and side before the limit pushes back.
        high: highest.
    """

    names: tuple[tuple[str, str], ...]
    flexes: tuple[float, float, float]
    spread: tuple[float, float, float]
    low: tuple[float, float, float]
    high: tuple[float, float, float]


_WIDE = (2.6, 2.6, 2.6)
_WIDE_LOW = (-2.6, -2.6, -2.6)

# Spreads are of everyday movement, limits of joint anatomy, both rounded (e.g. knee 0 to 150 degrees, elbow 0 to 150).
RULES: dict[str, JointRule] = {
    "spine_low": JointRule((("spine05", "spine03"), ("spine1", "spine2")), FORWARD, (0.25,) * 3, (-0.4,) * 3, (0.7, 0.4, 0.4)),
    "spine_mid": JointRule((("spine03", "spine01"), ("spine2", "spine3")), FORWARD, (0.2,) * 3, (-0.4,) * 3, (0.7, 0.4, 0.4)),
    "spine_high": JointRule((("spine01", "neck01"), ("spine3", "neck")), FORWARD, (0.2,) * 3, (-0.4,) * 3, (0.6, 0.4, 0.4)),
    "neck": JointRule((("neck01", "head"), ("neck", "head")), FORWARD, (0.25,) * 3, (-0.6,) * 3, (0.6,) * 3),
    "head": JointRule((("head", ""), ("head", "")), FORWARD, (0.3,) * 3, (-0.7, -0.9, -0.6), (0.7, 0.9, 0.6)),
    "collar": JointRule(
        (("clavicle.{side}", "upperarm01.{side}"), ("{side}_collar", "{side}_shoulder")),
        FORWARD, (0.15, 0.1, 0.15), (-0.4, -0.3, -0.5), (0.4, 0.3, 0.5),
    ),
    "shoulder": JointRule(
        (("upperarm01.{side}", "lowerarm01.{side}"), ("{side}_shoulder", "{side}_elbow")),
        FORWARD, (0.9, 0.7, 0.9), _WIDE_LOW, _WIDE,
    ),
    "elbow": JointRule(
        (("lowerarm01.{side}", "wrist.{side}"), ("{side}_elbow", "{side}_wrist")),
        FORWARD, (1.2, 0.5, 0.15), (-0.1, -1.3, -0.25), (2.6, 1.3, 0.25),
    ),
    "wrist": JointRule(
        (("wrist.{side}", "finger3-1.{side}"), ("{side}_wrist", "{side}_middle1")),
        FORWARD, (0.3, 0.3, 0.3), (-0.8, -0.5, -1.0), (0.8, 0.5, 1.0),
    ),
    "hip": JointRule(
        (("upperleg01.{side}", "lowerleg01.{side}"), ("{side}_hip", "{side}_knee")),
        FORWARD, (0.7, 0.3, 0.3), (-0.7, -0.9, -1.0), (2.4, 0.9, 1.0),
    ),
    "knee": JointRule(
        (("lowerleg01.{side}", "foot.{side}"), ("{side}_knee", "{side}_ankle")),
        BACKWARD, (0.8, 0.2, 0.08), (-0.05, -0.5, -0.15), (2.6, 0.5, 0.15),
    ),
    "ankle": JointRule(
        (("foot.{side}", "toe2-1.{side}"), ("{side}_ankle", "{side}_foot")),
        (0.0, 0.0, 1.0), (0.3, 0.2, 0.2), (-0.9, -0.4, -0.4), (0.6, 0.4, 0.4),
    ),
}  # fmt: skip


@dataclass(frozen=True)
class PosePrior:
    """The rules, laid on one body's moving joints (the root left out: it may turn anywhere).

    Attributes:
        free: indices of the moving joints in the body, the root first.
        axes: [F-1,3,3] rows are bend, twist and side axes in rest space.
        mean: [F-1,3] angles.
        spread: [F-1,3].
        low: [F-1,3].
        high: [F-1,3].
    """

    free: tuple[int, ...]
    axes: Tensor
    mean: Tensor
    spread: Tensor
    low: Tensor
    high: Tensor

    def angles(self, axis_angle: Tensor) -> Tensor:
        """Rotation vectors [T,F-1,3] of the joints after the root -> bend, twist and side [T,F-1,3]."""
        return (self.axes @ axis_angle[..., None])[..., 0]

    def residuals(self, axis_angle: Tensor, limit_spread: float = 0.05) -> Tensor:
        """Distance from the mean in spreads, and beyond the limits in `limit_spread` radians: [T,2,F-1,3]."""
        angles = self.angles(axis_angle)
        beyond = torch.relu(angles - self.high) - torch.relu(self.low - angles)
        return torch.stack([(angles - self.mean) / self.spread, beyond / limit_spread], dim=1)


def build_prior(body: BodyModel, betas: Tensor, resting: Tensor) -> PosePrior:
    """Find the moving joints on a body and their axes.

    Args:
        body: a `BodyModel`.
        betas: [S] shape whose rest skeleton gives the axes.
        resting: [J,3] axis-angle, the pose that joints tend to where nothing is seen (the root's row is ignored).

    Raises:
        ValueError: the body lacks a joint of the table under every known name.
    """
    index = {name: i for i, name in enumerate(body.joint_names)}
    with torch.no_grad():
        rest = body(torch.zeros(1, body.n_joints, 3), betas[None], torch.zeros(1, 3)).rest_joints[0]
    rows = []
    for role, rule in RULES.items():
        for sides in _sides(rule):
            joint, end = _find(index, role, rule, sides)
            rows.append((joint, _axes(rest, joint, end, rule.flexes), rule))
    rows.sort(key=lambda row: row[0])
    axes = torch.stack([row[1] for row in rows])
    joints = [row[0] for row in rows]
    # The limits win over a resting pose that lies outside of them.
    low, high = (torch.tensor([getattr(row[2], name) for row in rows]) for name in ("low", "high"))
    mean = (axes @ resting[joints][..., None])[..., 0].clamp(low, high)
    return PosePrior((0, *joints), axes, mean, torch.tensor([row[2].spread for row in rows]), low, high)


def _sides(rule: JointRule) -> Sequence[tuple[str, str]]:
    return (("L", "left"), ("R", "right")) if "{side}" in rule.names[0][0] else (("", ""),)


def _find(index: dict[str, int], role: str, rule: JointRule, sides: tuple[str, str]) -> tuple[int, int | None]:
    for (name, end), side in zip(rule.names, sides, strict=True):
        joint = index.get(name.format(side=side))
        if joint is not None:
            return joint, index.get(end.format(side=side))
    tried = ", ".join(name.format(side=side) for (name, _), side in zip(rule.names, sides, strict=True))
    raise ValueError(f"expected the body to have a joint for the {role}, one of {tried}; got {list(index)}")


def _axes(rest: Tensor, joint: int, end: int | None, flexes: tuple[float, float, float]) -> Tensor:
    """Bend, twist and side axes: bending carries the bone towards `flexes`; twist is about the bone; side completes them."""
    bone = rest[end] - rest[joint] if end is not None else torch.tensor([0.0, 0.0, 1.0])
    bone = torch.nn.functional.normalize(bone, dim=0)
    bend = torch.linalg.cross(bone, torch.tensor(flexes))
    bend = torch.nn.functional.normalize(bend, dim=0)
    return torch.stack([bend, bone, torch.linalg.cross(bend, bone)])
