"""Garments: found where the colours show them, and never filled from one another."""

from __future__ import annotations

import numpy as np
import pytest

from ahoy_core.texture.fill import fill_atlas
from ahoy_core.texture.parts import FOREARM_PART, LEG_PART, TRUNK_PART, best_cut, find_parts
from ahoy_core.texture.surface import Surface
from ahoy_core.texture.texels import TexelMap
from ahoy_core.texture.tones import NEUTRAL_CLOTH

from .synthetic import CapsuleBody
from .test_fill import observe, part_of

SHIRT, TROUSERS = np.array([210.0, 40, 30]), np.array([30.0, 50, 190])


@pytest.fixture(scope="module")
def rest(body: CapsuleBody) -> np.ndarray:
    return body.rest.numpy()


@pytest.mark.parametrize("fill", ["both", "harmonic", "symmetric"])
@pytest.mark.parametrize("legs_seen", [0.0, 0.05, 0.5])
def test_trousers_never_get_the_shirts_colour(
    body: CapsuleBody, surface: Surface, texels: TexelMap, rest: np.ndarray, fill: str, legs_seen: float
) -> None:
    part = part_of(body, surface, texels)
    leg = np.char.startswith(part, "leg")
    points = texels.points(rest, surface.faces)
    low = points[:, 2] < 0.84  # the torso's tip reaches between the legs
    colours = np.where(low[:, None], TROUSERS, SHIRT)
    # From the front, down to a height that leaves only a strip of the trousers in sight, or none.
    seen = (points[:, 1] < 0) & (points[:, 2] > 0.84 * (1 - legs_seen))
    filled = fill_atlas(observe(texels, colours, seen), surface, texels, rest, fill, light=False)
    clear = ~seen & (np.abs(points[:, 2] - 0.84) > 0.07)  # this body's vertices are 7 cm apart
    legs = filled.rgb.reshape(-1, 3)[texels.flat][leg & clear].astype(float)
    # Neither red in the trousers nor, seen or not, anything on the way to it: at most what the neutral grey has.
    assert legs[:, 0].max() <= max(TROUSERS[0], NEUTRAL_CLOTH[0] if not legs_seen else 0) + 2
    back = filled.rgb.reshape(-1, 3)[texels.flat][(part == "torso") & ~low & clear].astype(float)
    assert back[:, 2].max() <= SHIRT[2] + 2


def test_the_waist_is_where_the_colours_change_not_where_the_legs_begin(surface: Surface, rest: np.ndarray) -> None:
    low = rest[:, 2] < 0.9  # the legs' region ends at 0.84: these trousers reach higher
    parts = find_parts(surface, rest, np.where(low[:, None], TROUSERS, SHIRT), np.ones(len(rest), dtype=bool))
    assert "waist" in parts.found
    trunk = ~surface.head & ~surface.hands & (surface.limb != 1)
    np.testing.assert_array_equal(parts.of_vertex[trunk & low], LEG_PART)
    np.testing.assert_array_equal(parts.of_vertex[trunk & ~low], TRUNK_PART)


def test_a_dress_is_one_part_and_an_unseen_lower_half_is_not(surface: Surface, rest: np.ndarray) -> None:
    colours, everything = np.tile(SHIRT, (len(rest), 1)), np.ones(len(rest), dtype=bool)
    legs = surface.limb == 2
    assert not (find_parts(surface, rest, colours, everything).of_vertex[legs] == LEG_PART).any()
    assert (find_parts(surface, rest, colours, ~legs).of_vertex[legs] == LEG_PART).all()


def test_trousers_that_show_at_one_ankle_begin_where_the_shirt_may_end(surface: Surface, rest: np.ndarray) -> None:
    """Behind a desk: the shirt reaches a little down the legs, its end and the knees are hidden."""
    height = rest[:, 2]
    seen = (height > 0.76) | ((height < 0.3) & (rest[:, 0] < 0))
    parts = find_parts(surface, rest, np.where((height > 0.5)[:, None], SHIRT, TROUSERS), seen)
    assert "waist" in parts.found
    legs = (surface.limb == 2) & ~surface.feet
    assert (parts.of_vertex[legs & (height < 0.75)] == LEG_PART).all()
    assert (parts.of_vertex[legs & seen & (height > 0.76)] == TRUNK_PART).all()


def test_short_sleeves_end_where_the_skin_begins(surface: Surface, rest: np.ndarray, body: CapsuleBody) -> None:
    arm = np.char.startswith(body.parts, "arm")
    bare = arm & (rest[:, 2] < 1.1)
    parts = find_parts(surface, rest, np.where(bare[:, None], [200.0, 160, 140], SHIRT), arm)
    assert parts.found == ("sleeves",)
    assert (parts.of_vertex[bare] == FOREARM_PART).mean() > 0.8
    assert (parts.of_vertex[arm & (rest[:, 2] > 1.2)] == TRUNK_PART).all()


def test_garments_of_nearly_one_brightness_are_told_apart_and_folds_are_not() -> None:
    rng = np.random.default_rng(0)
    along = rng.uniform(0, 1, 400)
    folds = rng.uniform(0.6, 1.2, (400, 1))  # far more than the two garments differ
    shirt, jeans = np.array([58.0, 98, 148]), np.array([88.0, 108, 124])
    assert best_cut(along, folds * np.where(along[:, None] < 0.4, jeans, shirt)) == pytest.approx(0.4, abs=0.03)
    assert best_cut(along, folds * shirt) is None
    lit = 0.6 + 0.5 * along[:, None]  # a dress, brighter at the top
    assert best_cut(along, lit * folds * shirt) is None


def test_no_cut_is_seen_in_noise_in_stripes_or_in_nothing() -> None:
    rng = np.random.default_rng(0)
    along = rng.uniform(0, 1, 400)
    assert best_cut(along, rng.uniform(0, 255, (400, 3))) is None
    assert best_cut(along, np.where((along * 10).astype(int)[:, None] % 2, SHIRT, TROUSERS)) is None
    assert best_cut(along, np.tile(SHIRT, (400, 1))) is None
    assert best_cut(np.empty(0), np.empty((0, 3))) is None
    found = best_cut(along, np.where(along[:, None] < 0.3, SHIRT, TROUSERS) + rng.normal(0, 20, (400, 3)))
    assert found == pytest.approx(0.3, abs=0.03)
