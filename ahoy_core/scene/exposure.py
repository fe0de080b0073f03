"""Avatars over the time that a shutter is open: posed at up to three moments, in between by a curve.

A limb turns by a few degrees in an exposure: a parabola through three places of a Gaussian is within a hundredth of
a pixel of its arc, and costs a fraction of posing it (tests/scene/test_backdrop.py).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ahoy_core.avatar.avatar import Posed
from ahoy_core.body.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from ahoy_core.motion.motion import Motion
from ahoy_core.motion.time import slerp

KNOTS = 3


@dataclass(frozen=True)
class Exposure:
    """All avatars at 1 to 3 moments, in frames after the frame's start; their colours do not change in between."""

    moments: tuple[float, ...]
    posed: tuple[Posed, ...]

    def at(self, moment: float) -> Posed:
        """The avatars at a moment between the first and the last."""
        if moment in self.moments:
            return self.posed[self.moments.index(moment)]
        first, middle, last = self.posed
        a, b, c = self.moments
        x, y, z = (
            (moment - p) * (moment - q) / ((own - p) * (own - q)) for own, p, q in ((a, b, c), (b, a, c), (c, a, b))
        )
        means = x * first.means + y * middle.means + z * last.means
        # A line between two covariances keeps them positive, which a parabola would not.
        if moment < b:
            covars = torch.lerp(first.covars, middle.covars, (moment - a) / (b - a))
        else:
            covars = torch.lerp(middle.covars, last.covars, (moment - b) / (c - b))
        return Posed(means, covars, middle.colors, middle.opacities)


def knots(moments: Sequence[float]) -> tuple[float, ...]:
    """The moments at which avatars are posed, for pictures at `moments`."""
    distinct = sorted(set(moments))
    return tuple(distinct) if len(distinct) < KNOTS else (distinct[0], (distinct[0] + distinct[-1]) / 2, distinct[-1])


def at_moment(motion: Motion, frame: int, moment: float) -> tuple[Tensor, Tensor]:
    """Pose and translation a share of a frame after a frame; after the last one, motion goes on as it came."""
    if moment == 0 or len(motion) == 1:
        return motion.pose[frame], motion.transl[frame]
    other, share = frame + 1, moment
    if other >= len(motion):
        frame, other, share = frame - 1, frame, 1 + moment
    first, second = axis_angle_to_matrix(motion.pose[[frame, other]])
    pose = matrix_to_axis_angle(slerp(first, second, torch.full((len(first),), share)))
    return pose, torch.lerp(motion.transl[frame], motion.transl[other], share)
