"""Neighbourhoods on the body's surface: which texels touch, across UV seams too, and which lie opposite."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from ahoy_core.texture.rays import FloatArray, IntArray
from ahoy_core.texture.texels import TexelMap

# Neighbours in the atlas further apart on the body than this many typical texel spacings lie on different charts.
SAME_CHART_SPACINGS = 4.0
# Seam links reach this many typical spacings: a seam's two sides are rasterized on grids of their own.
SEAM_SPACINGS = 2.5
SEAM_NEIGHBOURS = 3
# How many metres a normal turned by 90 degrees counts for when looking for the opposite point, so that a hand's back
# does not match its palm.
NORMAL_METRES = 0.02
# A match further off than this many typical spacings is no match: what lies opposite was not seen.
MIRROR_SPACINGS = 3.0


def texel_links(texels: TexelMap, points: FloatArray, normals: FloatArray) -> IntArray:
    """Pairs [E,2] of texels that touch on the surface: grid neighbours of a chart, and nearest neighbours across seams.

    Args:
        texels: the atlas's texels.
        points: [N,3] where they are on the body, metres.
        normals: [N,3] unit.
    """
    pairs = _grid_pairs(texels)
    length = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    spacing = float(np.median(length)) if len(length) else 0.0
    pairs = pairs[length <= SAME_CHART_SPACINGS * spacing]
    degree = np.bincount(pairs.ravel(), minlength=len(points))
    border = np.flatnonzero(degree < 4)
    return np.concatenate([pairs, _seam_pairs(border, points, normals, SEAM_SPACINGS * spacing)])


def _grid_pairs(texels: TexelMap) -> IntArray:
    number = np.full(texels.size * texels.size, -1, dtype=np.int64)
    number[texels.flat] = np.arange(len(texels.flat))
    grid = number.reshape(texels.size, texels.size)
    across = np.stack([grid[:, :-1].ravel(), grid[:, 1:].ravel()], axis=1)
    down = np.stack([grid[:-1].ravel(), grid[1:].ravel()], axis=1)
    pairs = np.concatenate([across, down])
    return pairs[(pairs >= 0).all(axis=1)]


def _seam_pairs(border: IntArray, points: FloatArray, normals: FloatArray, reach: float) -> IntArray:
    if len(border) < 2 or reach <= 0:
        return np.empty((0, 2), dtype=np.int64)
    count = min(SEAM_NEIGHBOURS + 1, len(border))
    distance, near = cKDTree(points[border]).query(points[border], k=count, distance_upper_bound=reach)
    first = np.repeat(np.arange(len(border)), count)
    second, found = near.ravel(), np.isfinite(distance.ravel())
    first, second = first[found], second[found]
    pairs = np.sort(np.stack([border[first], border[second]], axis=1), axis=1)
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    # Fingers that touch are near but face each other: no colour flows between them.
    pairs = pairs[(normals[pairs[:, 0]] * normals[pairs[:, 1]]).sum(axis=1) > 0]
    return np.unique(pairs, axis=0)


def mirror_texels(
    points: FloatArray, normals: FloatArray, sources: IntArray, wanted: IntArray, middle: float, spacing: float
) -> IntArray:
    """The source texel opposite each wanted texel, across the body's plane of symmetry x = middle.

    Args:
        points: [N,3] texels on the canonical body, metres.
        normals: [N,3] unit.
        sources: [K] texel numbers that may be answers.
        wanted: [M] texel numbers.
        middle: x of the plane, metres.
        spacing: typical distance of neighbouring texels, metres.

    Returns:
        [M] texel numbers, -1 where no source lies opposite.
    """
    if len(sources) == 0:
        return np.full(len(wanted), -1)
    tree = cKDTree(np.concatenate([points, NORMAL_METRES * normals], axis=1)[sources])
    flip = np.array([-1.0, 1.0, 1.0])
    target = points[wanted] * flip + np.array([2 * middle, 0.0, 0.0])
    query = np.concatenate([target, NORMAL_METRES * normals[wanted] * flip], axis=1)
    _, match = tree.query(query, distance_upper_bound=MIRROR_SPACINGS * spacing)
    return np.append(sources, -1)[match]
