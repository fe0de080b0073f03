"""Stains at the edge of what was seen: furniture's colours go, what a garment shows further in stays."""

from __future__ import annotations

import numpy as np
import pytest

from ahoy_core.texture.fill import fill_atlas
from ahoy_core.texture.seen import read_seen
from ahoy_core.texture.stains import find_stains, without_stains
from ahoy_core.texture.surface import Surface
from ahoy_core.texture.texels import TexelMap

from .synthetic import CapsuleBody
from .test_fill import observe, part_of

SHIRT, WOOD, PRINT = (40.0, 70.0, 160.0), (170.0, 110.0, 50.0), (225.0, 225.0, 225.0)


class Shirt:
    """A torso seen in front of x = edge, a centimetre of wood beside it, and a print in the middle of what was seen."""

    def __init__(self, body: CapsuleBody, surface: Surface, texels: TexelMap) -> None:
        self.surface, self.texels, self.rest = surface, texels, body.rest.numpy()
        points = texels.points(self.rest, surface.faces)
        torso, front = part_of(body, surface, texels) == "torso", points[:, 1] < 0
        self.seen = torso & front & (points[:, 0] < 0.05)
        self.wood = self.seen & (points[:, 0] > 0.035)
        self.print = self.seen & (np.hypot(points[:, 0] + 0.04, points[:, 2] - 1.15) < 0.03)
        self.unseen = torso & ~self.seen
        self.colours = np.tile(np.array(SHIRT), (len(points), 1))
        self.colours[self.print] = PRINT

    def find(self, colours: np.ndarray) -> np.ndarray:
        told = read_seen(observe(self.texels, colours, self.seen), self.surface, self.texels, self.rest, light=False)
        return find_stains(told, self.surface, self.texels)

    def unseen_colours(self, colours: np.ndarray, drop: bool) -> np.ndarray:
        observed = observe(self.texels, colours, self.seen)
        if drop:
            told = read_seen(observed, self.surface, self.texels, self.rest)
            observed, share = without_stains(observed, told, self.surface, self.texels)
            assert 0 < share < 0.3
        filled = fill_atlas(observed, self.surface, self.texels, self.rest, light=False)
        return filled.rgb.reshape(-1, 3)[self.texels.flat[self.unseen]].astype(float)


@pytest.fixture(scope="module")
def shirt(body: CapsuleBody, surface: Surface, texels: TexelMap) -> Shirt:
    return Shirt(body, surface, texels)


def test_wood_at_the_edge_of_a_shirt_is_found_and_the_print_within_is_not(shirt: Shirt) -> None:
    colours = shirt.colours.copy()
    colours[shirt.wood] = WOOD
    found = shirt.find(colours)
    assert found[shirt.wood].mean() > 0.9 and not found[shirt.print].any()
    assert not found[shirt.seen & ~shirt.wood].any() and not found[~shirt.seen].any()


def test_what_was_never_seen_is_filled_from_the_shirt_and_not_from_the_wood(shirt: Shirt) -> None:
    colours = shirt.colours.copy()
    colours[shirt.wood] = WOOD
    brown, blue = (shirt.unseen_colours(colours, drop) for drop in (False, True))
    off = [np.abs(some - SHIRT).max(axis=1) for some in (brown, blue)]
    assert np.quantile(off[0], 0.8) > 40, "without it the stain spreads: else nothing is shown here"
    assert np.quantile(off[1], 0.8) < 15


def test_a_clean_shirt_folds_and_a_colour_that_changes_slowly_lose_nothing(shirt: Shirt) -> None:
    assert not shirt.find(shirt.colours).any()
    points = shirt.texels.points(shirt.rest, shirt.surface.faces)
    folds = shirt.colours * (1 + 0.15 * np.sin(points[:, 2:] * 200))
    assert not shirt.find(folds).any()
    fading = shirt.colours + 150 * np.clip(points[:, :1] + 0.1, 0, 0.3)
    assert not shirt.find(fading).any()


def test_a_speck_far_from_all_cloth_is_a_stain_unless_it_is_like_the_garment(shirt: Shirt) -> None:
    points = shirt.texels.points(shirt.rest, shirt.surface.faces)
    speck = shirt.unseen & (points[:, 1] > 0.09) & (np.abs(points[:, 2] - 1.15) < 0.01)
    for colour, dropped in ((WOOD, True), (SHIRT, False)):
        colours, seen = shirt.colours.copy(), shirt.seen | speck
        colours[speck] = colour
        told = read_seen(observe(shirt.texels, colours, seen), shirt.surface, shirt.texels, shirt.rest, light=False)
        found = find_stains(told, shirt.surface, shirt.texels)
        assert speck.sum() > 3 and (found[speck] == dropped).all()


def test_where_nothing_of_a_garment_lies_further_in_nothing_is_called_a_stain(shirt: Shirt) -> None:
    colours = shirt.colours.copy()
    colours[shirt.wood] = WOOD
    told = read_seen(observe(shirt.texels, colours, shirt.wood), shirt.surface, shirt.texels, shirt.rest, light=False)
    assert not find_stains(told, shirt.surface, shirt.texels).any()
