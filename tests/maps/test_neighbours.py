from __future__ import annotations

import torch

from ahoy_core.maps.neighbours import neighbours
from tests.avatar.scenes import template


def test_pairs_are_ordered_unique_and_near():
    start = template(64)
    pairs = neighbours(start)
    first, second = pairs.unbind(1)
    assert (first < second).all()
    assert len(torch.unique(pairs, dim=0)) == len(pairs)
    assert float((start.means[first] - start.means[second]).norm(dim=1).max()) <= 3 * start.pitch + 1e-6


def test_nearly_every_gaussian_has_neighbours_and_they_hold_the_body_together():
    """What spreads from the head along the pairs reaches feet and hands: no chart is an island."""
    start = template(128)
    first, second = neighbours(start).unbind(1)
    reached = start.head.clone()
    for _ in range(400):
        reached = reached.index_put((second,), reached[first] | reached[second])
        reached = reached.index_put((first,), reached[first] | reached[second])
    assert reached.float().mean() > 0.97
    assert reached[start.means[:, 2].argmin()]


def test_pairs_cross_the_border_between_the_charts():
    start = template(128)
    sides = start.pixels[:, 0][neighbours(start)]
    assert (sides[:, 0] != sides[:, 1]).sum() > 100


def test_two_sides_of_a_finger_are_no_neighbours():
    start = template(128)
    first, second = neighbours(start).unbind(1)
    normals = start.rotations[:, :, 2]
    assert float((normals[first] * normals[second]).sum(1).min()) > 0.29
