"""Which Gaussians of a template lie side by side on the surface, whatever chart they came from."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from ahoy_core.maps.template import Template

NEAREST = 6
"""Neighbours looked for: on a grid the four beside and two of the diagonal ones."""
# Further than this many pitches apart, two Gaussians are not side by side: on a slope the grid leaves up to two.
_REACH = 3.0
# Least cosine between the normals of neighbours: the two sides of a finger are near each other, and no neighbours.
_SAME_SIDE = 0.3


def neighbours(template: Template) -> Tensor:
    """Pairs of Gaussians that are side by side on the surface.

    Neighbours in the maps would end at the charts' borders, which is where the outlines of the front and back view lie.

    Args:
        template: N Gaussians.

    Returns:
        [E,2] int64, first below second, every pair once; among the six nearest of one of the two, within three pitches,
        their normals less than about 70 degrees apart.
    """
    points = template.means.double().numpy()
    count = min(NEAREST + 1, len(points))
    near, other = cKDTree(points).query(points, k=count, distance_upper_bound=_REACH * template.pitch)
    first = np.repeat(np.arange(len(points)), count)
    pairs = np.stack([first, np.asarray(other).ravel()], 1)[np.isfinite(np.asarray(near).ravel())]
    pairs = np.unique(np.sort(pairs[pairs[:, 0] != pairs[:, 1]], axis=1), axis=0)
    normals = template.rotations[:, :, 2].double().numpy()
    same = (normals[pairs[:, 0]] * normals[pairs[:, 1]]).sum(1) > _SAME_SIDE
    return torch.from_numpy(pairs[same].astype(np.int64))
