"""The light on a person, as far as what was seen tells: so that a fill copies colours of cloth and not of its light.

Colours in the atlas hold the light they were seen in. A lit front copied to the back, or one side to the other, is too
bright there. First-order light (ambient and one direction; the smooth part of any light on a matt body) is estimated
from the seen texels: the colour of each part times 1 + slope . normal. Fillings work on colours from which that is
divided out, and it is multiplied back at each texel's own normal.

From one side of a body the light along the line of sight can hardly be told from how round the body is, so there a
belief helps: cameras mostly look at the lit side (`BEHIND`). It is weighted by how one-sidedly the person was seen, and
is nothing for one who turned about.
"""

from __future__ import annotations

import numpy as np

from ahoy_core.texture.parts import FOOT_PART, HAND_PART, HEAD_PART
from ahoy_core.texture.rays import BoolArray, FloatArray, IntArray

# Believed slope for a person seen from one side alone (whose seen normals have a mean of some 0.6): what faces away
# from the camera has two thirds of the brightness of what faces it.
BEHIND = 0.2
# Weight of the belief against the mean over texels.
BELIEF = 0.1
# Colours further than this (share of the part's) from the model are prints, folds and shadows: they count little.
SCATTER = 0.15
# Brightness stays within these bounds of the part's: first order can go below what any room's walls throw back.
DARKEST, BRIGHTEST = 0.45, 1.6
LEAST_TEXELS = 200
_ROUNDS = 20
_LUMA = np.array([0.299, 0.587, 0.114])


def estimate_light(
    colours: FloatArray, normals: FloatArray, areas: FloatArray, part: IntArray, seen: BoolArray
) -> FloatArray:
    """Slope [3] of brightness over the normal, in the canonical body's frame; zero where too little was seen.

    Args:
        colours: [N,3] in 0..255 of the atlas's texels.
        normals: [N,3] unit, canonical pose.
        areas: [N] square metres.
        part: [N] parts; each has a colour of its own.
        seen: [N] bool.
    """
    cloth = seen & ~np.isin(part, (HEAD_PART, HAND_PART, FOOT_PART))
    if cloth.sum() < LEAST_TEXELS:
        return np.zeros(3)
    brightness, X, weight = colours[cloth] @ _LUMA, normals[cloth], areas[cloth] / areas[cloth].sum()
    numbers, which = np.unique(part[cloth], return_inverse=True)
    toward = (normals[seen] * areas[seen, None]).sum(axis=0) / max(float(areas[seen].sum()), 1e-12)
    belief = BEHIND * toward / 0.6
    slope = belief.copy()
    for _ in range(_ROUNDS):
        level = brightness / np.maximum(1 + X @ slope, DARKEST)
        own = np.array([np.median(level[which == k]) for k in range(len(numbers))])
        ratio = brightness / np.maximum(own[which], 1.0) - 1
        trust = weight / (1 + np.square((ratio - X @ slope) / SCATTER))
        trust /= trust.sum()
        gram = (X * trust[:, None]).T @ X + BELIEF * np.eye(3)
        slope = np.linalg.solve(gram, (X * trust[:, None]).T @ ratio + BELIEF * belief)
    return slope


def shading(normals: FloatArray, slope: FloatArray) -> FloatArray:
    """Brightness [N] at unit normals [N,3] as a share of the colour's own."""
    bounded: FloatArray = np.clip(1 + normals @ slope, DARKEST, BRIGHTEST)
    return bounded
