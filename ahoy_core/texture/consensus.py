"""What most frames show of each texel: a ball that a mask took for the person passes by, the shirt behind it stays.

First write wins (paper section 3.1) keeps whatever came first. The masks of the embedded default include held objects,
and a fit that is off for a moment paints an arm onto the chest; both contradict the other frames, so they are left out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from ahoy_core.texture.rays import BoolArray, FloatArray, IntArray

# With fewer views of a texel there is no majority.
LEAST_VOTES = 3


# A texel without a majority of its own is asked to look like one of these many settled texels near it ...
PALETTE = 16
# ... of every n-th, so that they spread over some centimetres instead of one seam ...
PALETTE_STRIDE = 16
# ... within this many metres; with none so near, its colour is taken as it is.
PALETTE_REACH = 0.12


@dataclass(frozen=True)
class Consensus:
    """What most frames show of N texels.

    rgb [N,3] uint8 medians, votes [N] (0: no colour), tolerance in levels of 255, palette [N,P] texel numbers whose
    colours a texel without a majority may have (-1: none).
    """

    rgb: IntArray
    votes: IntArray
    tolerance: float
    palette: IntArray

    def scaled(self, gain: FloatArray) -> Consensus:
        """The same at another exposure: colours times gain [3]."""
        return replace(self, rgb=np.clip(np.rint(self.rgb * gain), 0, 255).astype(np.uint8))

    def agrees(self, texel: IntArray, rgb: IntArray) -> BoolArray:
        """Whether colours [K,3] uint8 of texels [K] agree with what most frames show, or nothing can tell. [K] bool."""
        own = self.votes[texel] >= LEAST_VOTES
        agreeing = ~own
        agreeing[own] = self._close(rgb[own], self.rgb[texel[own]])
        around = self.palette[texel[~own]]
        near = self._close(rgb[~own][:, None], self.rgb[around]) & (around >= 0)
        agreeing[~own] = near.any(axis=1) | (around < 0).all(axis=1)
        return agreeing

    def closeness(self, texel: IntArray, rgb: IntArray) -> FloatArray:
        """How near colours [K,3] uint8 of texels [K] are to what most frames show: 1 the same, 0 far off."""
        gap = np.abs(rgb.astype(np.int16) - self.rgb[texel]).sum(axis=-1)
        nearness: FloatArray = (1 / (1 + gap)).astype(np.float32)
        return nearness

    def _close(self, a: IntArray, b: IntArray) -> BoolArray:
        close: BoolArray = np.abs(a.astype(np.int16) - b).max(axis=-1) <= self.tolerance
        return close


class Votes:
    """Collects colours of N texels from at most `capacity` frames."""

    def __init__(self, count: int, capacity: int) -> None:
        self._rgb = np.full((capacity, count, 3), 255, dtype=np.uint8)
        self._cast = np.zeros(count, dtype=np.int32)

    def add(self, texel: IntArray, rgb: IntArray) -> None:
        """One frame's vote: colours [K,3] uint8 of texels [K], each named once."""
        self._rgb[self._cast[texel], texel] = rgb
        self._cast[texel] += 1

    def consensus(self, points: FloatArray, tolerance: float) -> Consensus:
        """The median (lower of the middle two) of each texel and channel.

        Args:
            points: [N,3] the texels on the canonical body, metres.
            tolerance: levels of 255.
        """
        # Places that were not voted for hold 255 and sort behind every vote.
        ordered = np.sort(self._rgb, axis=0)
        middle = np.maximum(self._cast - 1, 0) // 2
        rgb = ordered[middle, np.arange(len(middle))]
        return Consensus(rgb, self._cast, tolerance, _palette(points, self._cast >= LEAST_VOTES))


def _palette(points: FloatArray, settled: BoolArray) -> IntArray:
    """For each unsettled texel, settled ones near it; -1 where there are no more. [N,P]."""
    palette = np.full((len(points), PALETTE), -1)
    sources = np.flatnonzero(settled)[::PALETTE_STRIDE]
    if len(sources):
        _, index = cKDTree(points[sources]).query(points[~settled], k=PALETTE, distance_upper_bound=PALETTE_REACH)
        palette[~settled] = np.append(sources, -1)[index]
    return palette
