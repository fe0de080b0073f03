"""Stains at the edge of what was seen: furniture's colours that a mask, some pixels too wide, put onto clothes.

They are few, but everything unseen is filled from there: a shelf's rim becomes a brown stripe down a shirt and a
shadow on its back. So what lies at the edge and is unlike the same garment further in counts as unseen.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from ahoy_core.texture.atlas import ObservedAtlas
from ahoy_core.texture.parts import HAND_PART, HEAD_PART, little_lightness
from ahoy_core.texture.rays import BoolArray, FloatArray
from ahoy_core.texture.seen import Seen, at_vertices
from ahoy_core.texture.surface import Surface
from ahoy_core.texture.texels import TexelMap

EDGE_M = 0.04  # so far from unseen surface of the same part a stain may lie: some pixels of a whole person
TURN_M = 0.04  # metres that a turn of the normal by a radian counts: an arm's unseen back is not near its front
NEAR_M = 0.12  # with no cloth further in so near, what is seen of the whole part tells: specks on an unseen leg
CLOTH_M = 0.06  # the garment's colour is the median over so much cloth, from the nearest on
VERTICES = 24  # ... and over no more vertices than these
UNLIKE = 16.0  # CIE Lab, lightness counted less: folds and stripes are nearer to their garment than this


def without_stains(
    observed: ObservedAtlas, seen: Seen, surface: Surface, texels: TexelMap
) -> tuple[ObservedAtlas, float]:
    """The atlas with its stains unseen, and their share of what was seen.

    Args:
        observed: what was seen.
        seen: the same, read.
        surface: the body's triangles.
        texels: the atlas's texels on them.
    """
    stains = find_stains(seen, surface, texels)
    if not stains.any():
        return observed, 0.0
    coverage, source, rgb = observed.coverage.copy(), observed.source_frame.copy(), observed.rgb.copy()
    where = texels.flat[stains]
    coverage.reshape(-1)[where], source.reshape(-1)[where], rgb.reshape(-1, 3)[where] = 0, -1, 0
    share = float(seen.areas[stains].sum() / seen.areas[seen.seen].sum())
    return replace(observed, rgb=rgb, coverage=coverage, source_frame=source), share


def find_stains(seen: Seen, surface: Surface, texels: TexelMap) -> BoolArray:
    """Which texels [N] lie at the edge of what was seen of a garment and are unlike it.

    Head and hands are left alone: hair, eyes and rings belong there.
    """
    place = np.concatenate([seen.points, TURN_M * seen.normals], axis=1)
    colours = little_lightness(seen.colours)
    stains = np.zeros(len(place), dtype=bool)
    for number in np.unique(seen.part):
        known, unknown = ((seen.part == number) & some for some in (seen.seen, ~seen.seen))
        if number in (HEAD_PART, HAND_PART) or not (known.any() and unknown.any()):
            continue
        rows = np.flatnonzero(known)
        away, _ = cKDTree(place[unknown]).query(place[rows], distance_upper_bound=EDGE_M)
        inner, edge = rows[np.isinf(away)], rows[np.isfinite(away)]
        if len(inner) and len(edge):
            stains[edge] = _unlike(place, colours, inner, edge, surface, texels)
    return stains


def _unlike(
    place: FloatArray,
    colours: FloatArray,
    inner: np.ndarray,
    edge: np.ndarray,
    surface: Surface,
    texels: TexelMap,
) -> BoolArray:
    """Which texels at the edge [E] are unlike what lies further in beside them, or else unlike the part as a whole."""
    within = np.zeros(len(place), dtype=bool)
    within[inner] = True
    (at, weight), (where, _) = (at_vertices(surface, texels, values, within) for values in (colours, place[:, :3]))
    turned, _ = at_vertices(surface, texels, place[:, 3:], within)
    there = weight > 0
    count = min(VERTICES, int(there.sum()))
    away, index = cKDTree(np.concatenate([where, turned], axis=1)[there]).query(place[edge], k=count)
    away, index = away.reshape(len(edge), count), index.reshape(len(edge), count)
    beside = away <= away[:, :1] + CLOTH_M
    garment = np.nanmedian(np.where(beside[:, :, None], at[there][index], np.nan), axis=1)
    garment[away[:, 0] > NEAR_M] = np.median(colours[inner], axis=0)
    return np.asarray(np.linalg.norm(colours[edge] - garment, axis=1) > UNLIKE)
