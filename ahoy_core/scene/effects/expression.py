"""Expression: the face of a motion; `Avatar.face_offset` carries it to the Gaussians of the head."""

from __future__ import annotations

import torch

from ahoy_core.scene.cost import Rates
from ahoy_core.scene.effects.effect import Effect, Verdict
from ahoy_core.scene.puppet import Puppet
from ahoy_core.scene.shot import Content

LEAST_PIXELS = 20
"""Height in pixels of a head under which a smile is less than a pixel."""
_LEAST_ACTION = 0.02
# Cosine between where the face looks and where the camera is, beyond which only the back of the head is seen.
_LEAST_FACING = -0.2


def head_pixels(content: Content, puppet: Puppet, number: int) -> tuple[float, float]:
    """Height in pixels of a head at a moment, and the cosine between where it looks and where the camera is."""
    frame = content.moments[number]
    rows = torch.nonzero(puppet.avatar.head)[:, 0]
    rows = rows[:: max(1, len(rows) // 200)]
    if not len(rows):
        return 0.0, 1.0
    relative = puppet.relative(puppet.motion.pose[[frame]], puppet.motion.transl[[frame]])[0]
    places, _ = puppet.points[rows].posed(relative)
    cameras = content.shot.at(frame)
    pixels, depths = cameras.project(places)
    inside = depths[0] > 0.05
    if not bool(inside.any()):
        return 0.0, 1.0
    v = pixels[0, inside, 1].clamp(0, cameras.height)
    joint = puppet.body.joint_names.index("head")
    towards = torch.nn.functional.normalize(cameras.centers[0] - places.mean(0), dim=0)
    return float(v.max() - v.min()), float(-relative[joint, :3, 1] @ towards)


def _judge(content: Content) -> Verdict:
    moving = [p for p in content.puppets if _has_action(p)]
    if not moving:
        return Verdict(False, "the motion has no expression")
    seen = [head_pixels(content, p, n) for p in moving for n in range(len(content.moments))]
    tall = max((pixels for pixels, facing in seen if facing > _LEAST_FACING), default=0.0)
    evidence = {"head_pixels": round(tall, 1)}
    if tall == 0:
        return Verdict(False, "no face is turned to the camera", evidence)
    if tall < LEAST_PIXELS:
        return Verdict(False, f"heads are at most {tall:.0f} pixels high", evidence)
    return Verdict(True, f"a face {tall:.0f} pixels high is turned to the camera and moves", evidence, LEAST_PIXELS)


def _has_action(puppet: Puppet) -> bool:
    expression = puppet.motion.expression
    return expression is not None and float(expression.abs().max()) > _LEAST_ACTION


def _seconds(content: Content, verdict: Verdict, rates: Rates) -> float:
    return rates.face * sum(_has_action(p) for p in content.puppets)


EXPRESSION = Effect(
    "expression",
    "faces move",
    _judge,
    _seconds,
    lambda content: any(_has_action(puppet) for puppet in content.puppets),
)
