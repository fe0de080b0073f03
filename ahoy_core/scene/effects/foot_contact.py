"""Foot contact: feet that stand do not slide, and nothing sinks into the ground or hovers over it.

The whole motion is first shifted so that its feet reach the ground; then, while a foot stands, its leg is solved to
keep the foot where it stands (`motion.legs`). Corrections fade in and out over a few frames around each contact.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ahoy_core.motion.legs import SIDES, joints_of, legs_of, reach_ankles
from ahoy_core.motion.motion import Motion
from ahoy_core.scene.cost import Rates
from ahoy_core.scene.effects.effect import Effect, Verdict
from ahoy_core.scene.puppet import Points, Puppet
from ahoy_core.scene.shot import Content

# A foot stands while its sole is lower than this (metres) and slower than this (metres a second).
_LOW, _SLOW = 0.03, 0.4
# Metres of sinking, hovering and sliding that a viewer notices.
_SINKS, _HOVERS, _SLIDES = 0.005, 0.01, 0.01
_FADE = 0.12  # seconds
_FARTHEST = 0.15  # metres that a foot is moved at most: beyond that the motion, not the contact, is wrong


@dataclass(frozen=True)
class Feet:
    """Soles of both feet over T frames: heights [T,2] of their lowest parts, places [T,2,3], standing [T,2] bool."""

    heights: Tensor
    places: Tensor
    standing: Tensor

    @property
    def sinking(self) -> float:
        """Metres that a sole is under the ground at the worst."""
        return float((-self.heights).max().clamp(min=0))

    @property
    def hovering(self) -> float:
        """Metres between the ground and the soles at their lowest over the whole motion."""
        return float(self.heights.amin(1).quantile(0.1))

    @property
    def sliding(self) -> float:
        """The longest way, in metres, that a foot goes during one contact."""
        worst = 0.0
        for foot in range(2):
            for first, last in spans(self.standing[:, foot]):
                way = self.places[first : last + 1, foot, :2]
                worst = max(worst, float((way - way.mean(0)).norm(dim=1).max()) * 2)
        return worst


def soles(puppet: Puppet) -> list[Points]:
    """Surface points of both soles: those of the feet that are lowest in the canonical pose."""
    found = []
    for side in SIDES:
        ankle = legs_of(puppet.body)[side].ankle
        own = [j for j in range(len(puppet.body.parents)) if _descends(puppet.body.parents, j, ankle)]
        weight = puppet.points.lbs_weights[:, own].sum(1)
        heights = puppet.points.means[:, 2]
        foot = weight > 0.5
        rows = (
            torch.nonzero(foot & (heights < heights[foot].min() + 0.03))[:, 0] if bool(foot.any()) else torch.tensor([])
        )
        if not len(rows):
            raise ValueError(
                f"expected Gaussians on the {side} foot, got none; is the avatar's body {puppet.body.name}?"
            )
        found.append(puppet.points[rows[:: max(1, len(rows) // 60)]])
    return found


def _descends(parents: tuple[int, ...], joint: int, ancestor: int) -> bool:
    while joint > ancestor:
        joint = parents[joint]
    return joint == ancestor


def feet_of(puppet: Puppet) -> Feet:
    """Where a puppet's soles are, and when they stand on the ground z = 0."""
    relative = puppet.relative(puppet.motion.pose, puppet.motion.transl)
    heights, places = [], []
    for points in soles(puppet):
        posed = torch.stack([points.posed(one)[0] for one in relative])
        heights.append(posed[:, :, 2].quantile(0.05, 1))
        places.append(posed.mean(1))
    height, place = torch.stack(heights, 1), torch.stack(places, 1)
    speed = torch.zeros_like(height)
    if len(place) > 1:
        steps = (place[1:] - place[:-1])[:, :, :2].norm(dim=2) * puppet.motion.fps
        # The faster of the ways in and out: a foot that is about to leave is no anchor.
        speed = torch.maximum(torch.cat([steps[:1], steps]), torch.cat([steps, steps[-1:]]))
    level = height.amin(1).quantile(0.1)
    return Feet(height, place, (height - level < _LOW) & (speed < _SLOW))


def spans(mask: Tensor) -> list[tuple[int, int]]:
    """First and last index of every run of True."""
    edges = torch.diff(torch.cat([torch.tensor([0]), mask.int(), torch.tensor([0])]))
    starts, ends = torch.nonzero(edges == 1)[:, 0], torch.nonzero(edges == -1)[:, 0] - 1
    return list(zip(starts.tolist(), ends.tolist(), strict=True))


def corrected(puppet: Puppet) -> Puppet:
    """The puppet with its feet put right."""
    feet = feet_of(puppet)
    level = float(feet.heights.amin(1).quantile(0.1))
    shift = -level if abs(level) > _SINKS else 0.0
    motion = replace(puppet.motion, transl=puppet.motion.transl + torch.tensor([0.0, 0.0, shift]))
    rest = puppet.rest
    joints = joints_of(puppet.body, motion.rotations(), rest, motion.transl)
    targets = {}
    for number, side in enumerate(SIDES):
        offset = _offsets(feet, number, shift, motion)
        targets[side] = joints[:, legs_of(puppet.body)[side].ankle] + offset
    pose = reach_ankles(puppet.body, motion.pose, motion.transl, rest, targets)
    return replace(puppet, motion=replace(motion, pose=pose))


def _offsets(feet: Feet, number: int, shift: float, motion: Motion) -> Tensor:
    """[T,3]: how far each frame's foot has to move."""
    height, places = feet.heights[:, number] + shift, feet.places[:, number]
    offset = torch.zeros(len(height), 3)
    weight = torch.zeros(len(height))
    fade = max(1, round(_FADE * motion.fps))
    for first, last in spans(feet.standing[:, number]):
        inside = slice(first, last + 1)
        anchor = places[inside, :2].mean(0)
        offset[inside, :2] = anchor - places[inside, :2]
        offset[inside, 2] = -height[inside]
        weight[inside] = 1
        for before, edge, step in ((first, first, -1), (last, last, 1)):
            for k in range(1, fade):
                frame = before + step * k
                if 0 <= frame < len(weight) and not bool(feet.standing[frame, number]):
                    share = 0.5 + 0.5 * math.cos(math.pi * k / fade)
                    if share > weight[frame]:
                        offset[frame], weight[frame] = share * offset[edge], share
    sunk = (-height - offset[:, 2]).clamp(min=0)
    offset[:, 2] += sunk
    length = offset.norm(dim=1, keepdim=True)
    return offset * (_FARTHEST / length.clamp(min=_FARTHEST))


def _judge(content: Content) -> Verdict:
    if content.scene.ground is None or not content.puppets:
        return Verdict(False, "no ground was found" if content.puppets else "there is no avatar")
    feet = [feet_of(puppet) for puppet in content.puppets]
    sinks, slides = max(f.sinking for f in feet), max(f.sliding for f in feet)
    hovers = max(f.hovering for f in feet)
    evidence = {"sinking_m": round(sinks, 4), "hovering_m": round(hovers, 4), "sliding_m": round(slides, 4)}
    if not any(bool(f.standing.any()) for f in feet):
        return Verdict(False, "no foot ever stands on the ground", evidence)
    for amount, bound, what in ((sinks, _SINKS, "sink"), (hovers, _HOVERS, "hover"), (slides, _SLIDES, "slide")):
        if amount > bound:
            return Verdict(True, f"feet {what} by up to {100 * amount:.1f} cm", evidence)
    return Verdict(False, "feet stand on the ground and do not slide", evidence)


def _seconds(content: Content, verdict: Verdict, rates: Rates) -> float:
    return len(content.puppets) * content.frames * rates.joints


FOOT_CONTACT = Effect(
    "foot_contact",
    "feet stand on the ground without sinking or sliding",
    _judge,
    _seconds,
    lambda content: bool(content.puppets) and content.scene.ground is not None,
)
