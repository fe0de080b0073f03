from __future__ import annotations

import numpy as np
import torch
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from ahoy_core.maps.neighbours import neighbours
from tests.avatar.scenes import template


def test_pairs_are_ordered_unique_and_near():
    start = template(64)
    pairs = neighbours(start)
    first, second = pairs.unbind(1)
    assert (first < second).all()
    assert len(torch.unique(pairs, dim=0)) == len(pairs)
    assert float((start.means[first] - start.means[second]).norm(dim=1).max()) <= 3 * start.pitch + 1e-6


def test_the_pairs_hold_the_body_together():
    """No chart is an island: nearly all Gaussians are linked, step by step."""
    start = template(128)
    first, second = neighbours(start).numpy().T
    links = coo_matrix((np.ones(len(first)), (first, second)), shape=(len(start), len(start)))
    _, island = connected_components(links, directed=False)
    assert np.bincount(island).max() > 0.97 * len(start)


def test_pairs_cross_the_border_between_the_charts():
    start = template(128)
    sides = start.pixels[:, 0][neighbours(start)]
    assert (sides[:, 0] != sides[:, 1]).sum() > 100


def test_two_sides_of_a_finger_are_no_neighbours():
    start = template(128)
    first, second = neighbours(start).unbind(1)
    normals = start.rotations[:, :, 2]
    assert float((normals[first] * normals[second]).sum(1).min()) > 0.29
