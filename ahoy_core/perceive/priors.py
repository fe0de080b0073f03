"""Which joints the fit moves, where they tend to be, and how far they go.

Angles are components of the rotation vector in three anatomical axes of each joint: `bend` (flexion positive),
`twist` (about the bone) and `side`. The axes come from the rest skeleton, so the table below holds for any body whose
rest pose stands and faces -y.
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
        towards: direction of the bone in a person who just stands (left side; the right one is mirrored), None: as at
            rest.
        bent: radians of bending in a person who just stands.
    """

    names: tuple[tuple[str, str], ...]
    flexes: tuple[float, float, float]
    spread: tuple[float, float, float]
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    towards: tuple[float, float, float] | None = None
    bent: float = 0.0


_WIDE = (2.6, 2.6, 2.6)
_WIDE_LOW = (-2.6, -2.6, -2.6)

# Spreads are of everyday movement, limits of joint anatomy, both rounded (e.g. knee 0 to 150 degrees, elbow 0 to 150).
RULES: dict[str, JointRule] = {
    "spine_low": JointRule(
        (("spine05", "spine03"), ("spine1", "spine2")), FORWARD, (0.25,) * 3, (-0.4,) * 3, (0.7, 0.4, 0.4)
    ),
    "spine_mid": JointRule(
        (("spine03", "spine01"), ("spine2", "spine3")), FORWARD, (0.2,) * 3, (-0.4,) * 3, (0.7, 0.4, 0.4)
    ),
    "spine_high": JointRule(
        (("spine01", "neck01"), ("spine3", "neck")), FORWARD, (0.2,) * 3, (-0.4,) * 3, (0.6, 0.4, 0.4)
    ),
    "neck": JointRule((("neck01", "head"), ("neck", "head")), FORWARD, (0.25,) * 3, (-0.6,) * 3, (0.6,) * 3),
    "head": JointRule((("head", ""), ("head", "")), FORWARD, (0.3,) * 3, (-0.7, -0.9, -0.6), (0.7, 0.9, 0.6)),
    "collar": JointRule(
        (("clavicle.{side}", "upperarm01.{side}"), ("{side}_collar", "{side}_shoulder")),
        FORWARD, (0.15, 0.1, 0.15), (-0.4, -0.3, -0.5), (0.4, 0.3, 0.5),
    ),
    "shoulder": JointRule(
        (("upperarm01.{side}", "lowerarm01.{side}"), ("{side}_shoulder", "{side}_elbow")),
        FORWARD, (0.9, 0.7, 0.9), _WIDE_LOW, _WIDE, towards=(0.25, -0.05, -1.0),
    ),
    "elbow": JointRule(
        (("lowerarm01.{side}", "wrist.{side}"), ("{side}_elbow", "{side}_wrist")),
        FORWARD, (1.2, 0.5, 0.15), (-0.1, -1.3, -0.25), (2.6, 1.3, 0.25), bent=0.3,
    ),
    "wrist": JointRule(
        (("wrist.{side}", "finger3-1.{side}"), ("{side}_wrist", "{side}_middle1")),
        FORWARD, (0.3, 0.3, 0.3), (-0.8, -0.5, -1.0), (0.8, 0.5, 1.0),
    ),
    # People at ease stand with their heels 17 cm apart (McIlroy and Maki 1997), nearer than the packaged body at rest.
    "hip": JointRule(
        (("upperleg01.{side}", "lowerleg01.{side}"), ("{side}_hip", "{side}_knee")),
        FORWARD, (0.7, 0.3, 0.3), (-0.7, -0.9, -1.0), (2.4, 0.9, 1.0), towards=(-0.02, 0.0, -1.0),
    ),
    "knee": JointRule(
        (("lowerleg01.{side}", "foot.{side}"), ("{side}_knee", "{side}_ankle")),
        BACKWARD, (0.8, 0.2, 0.08), (-0.05, -0.5, -0.15), (2.6, 0.5, 0.15), bent=0.1,
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

    def departure(self, axis_angle: Tensor) -> Tensor:
        """Distance from the mean in spreads, [T,F-1,3]."""
        return (self.angles(axis_angle) - self.mean) / self.spread

    def beyond(self, axis_angle: Tensor) -> Tensor:
        """Radians above the upper limit (positive) or below the lower one (negative), [T,F-1,3]."""
        angles = self.angles(axis_angle)
        return torch.relu(angles - self.high) - torch.relu(self.low - angles)


def build_prior(body: BodyModel, betas: Tensor) -> PosePrior:
    """Find the moving joints on a body, their axes, and the pose of a person who just stands.

    Args:
        body: a `BodyModel`.
        betas: [S] shape whose rest skeleton gives the axes; its dtype is the result's.

    Raises:
        ValueError: the body lacks a joint of the table under every known name.
    """
    index = {name: i for i, name in enumerate(body.joint_names)}
    with torch.no_grad():
        like = body.default_betas
        rest = body(like.new_zeros(1, body.n_joints, 3), betas[None].to(like), like.new_zeros(1, 3)).rest_joints[0]
    rest = rest.to(betas)
    rows = []
    for role, rule in RULES.items():
        for side, names in _sides(rule):
            joint, end = _find(index, role, rule, names)
            axes = _axes(rest, joint, end, rule.flexes)
            rows.append((joint, rule, axes, _standing(rule, axes, side)))
    rows.sort(key=lambda row: row[0])
    low, high, spread = (
        torch.tensor([getattr(row[1], name) for row in rows]).to(betas) for name in ("low", "high", "spread")
    )
    # The limits win over a standing pose that lies outside of them.
    mean = torch.stack([row[3] for row in rows]).clamp(low, high)
    return PosePrior((0, *(row[0] for row in rows)), torch.stack([row[2] for row in rows]), mean, spread, low, high)


def _standing(rule: JointRule, axes: Tensor, side: int) -> Tensor:
    """Angles [3] of a standing person: the least turn that points the bone where `towards` says, then `bent`."""
    angles = torch.zeros(3).to(axes)
    if rule.towards is not None:
        target = torch.nn.functional.normalize(torch.tensor(rule.towards).to(axes) * torch.tensor([side, 1, 1]), dim=0)
        bone = axes[1]
        axis = torch.linalg.cross(bone, target)
        sine, cosine = axis.norm(), bone @ target
        if float(sine) > 1e-6:
            angles = axes @ (axis / sine * torch.atan2(sine, cosine))
    return angles + torch.tensor([rule.bent, 0.0, 0.0]).to(axes)


def _sides(rule: JointRule) -> Sequence[tuple[int, tuple[str, str]]]:
    """The sign of x and both ways to spell a side, for each side that the joint has."""
    return ((1, ("L", "left")), (-1, ("R", "right"))) if "{side}" in rule.names[0][0] else ((1, ("", "")),)


def _find(index: dict[str, int], role: str, rule: JointRule, sides: tuple[str, str]) -> tuple[int, int | None]:
    for (name, end), side in zip(rule.names, sides, strict=True):
        joint = index.get(name.format(side=side))
        if joint is not None:
            return joint, index.get(end.format(side=side))
    tried = ", ".join(name.format(side=side) for (name, _), side in zip(rule.names, sides, strict=True))
    raise ValueError(f"expected the body to have a joint for the {role}, one of {tried}; got {list(index)}")


def _axes(rest: Tensor, joint: int, end: int | None, flexes: tuple[float, float, float]) -> Tensor:
    """Bend, twist and side axes: bending carries the bone towards `flexes`, twist is about it, side completes them."""
    bone = rest[end] - rest[joint] if end is not None else torch.tensor([0.0, 0.0, 1.0]).to(rest)
    bone = torch.nn.functional.normalize(bone, dim=0)
    bend = torch.linalg.cross(bone, torch.tensor(flexes).to(rest))
    bend = torch.nn.functional.normalize(bend, dim=0)
    return torch.stack([bend, bone, torch.linalg.cross(bend, bone)])
