"""The simple fill: complete, seamless, symmetric, and what was seen stays as it was seen."""

from __future__ import annotations

import numpy as np
import pytest

from ahoy_core.texture.atlas import ObservedAtlas
from ahoy_core.texture.diffusion import Pull, solve_links
from ahoy_core.texture.fill import fill_atlas
from ahoy_core.texture.links import mirror_texels, texel_links
from ahoy_core.texture.surface import Surface
from ahoy_core.texture.texels import TexelMap, texel_normals
from ahoy_core.texture.tones import NEUTRAL_SKIN, NEUTRAL_TROUSERS

from .synthetic import CapsuleBody, smooth_paint


def observe(texels: TexelMap, colours: np.ndarray, seen: np.ndarray) -> ObservedAtlas:
    """An atlas of colours [N,3] where seen [N]."""
    size = texels.size
    rgb = np.zeros((size * size, 3), dtype=np.uint8)
    coverage = np.zeros(size * size, dtype=np.float32)
    rgb[texels.flat[seen]] = np.rint(colours[seen])
    coverage[texels.flat[seen]] = 1
    source = np.where(coverage > 0, 0, -1).astype(np.int32)
    return ObservedAtlas(rgb.reshape(size, size, 3), coverage.reshape(size, size), source.reshape(size, size))


def part_of(body: CapsuleBody, surface: Surface, texels: TexelMap) -> np.ndarray:
    return body.parts[surface.faces[texels.face, 0]]


@pytest.fixture(scope="module")
def rest(body: CapsuleBody) -> np.ndarray:
    return body.rest.numpy()


def test_seen_texels_keep_their_colours_bit_by_bit(surface: Surface, texels: TexelMap, rest: np.ndarray) -> None:
    rng = np.random.default_rng(0)
    colours = rng.uniform(0, 255, (len(texels.face), 3))
    seen = rng.random(len(texels.face)) < 0.3
    observed = observe(texels, colours, seen)
    filled = fill_atlas(observed, surface, texels, rest)
    where = observed.coverage > 0
    np.testing.assert_array_equal(filled.rgb[where], observed.rgb[where])


def test_nothing_seen_gives_neutral_cloth_and_skin(
    body: CapsuleBody, surface: Surface, texels: TexelMap, rest: np.ndarray
) -> None:
    nothing = observe(texels, np.zeros((len(texels.face), 3)), np.zeros(len(texels.face), dtype=bool))
    filled = fill_atlas(nothing, surface, texels, rest)
    assert filled.skin_from == "neutral"
    assert filled.diffused == pytest.approx(1)
    colours = filled.rgb.reshape(-1, 3)[texels.flat].astype(float)
    part = part_of(body, surface, texels)
    np.testing.assert_allclose(colours[part == "hand.L"].mean(axis=0), NEUTRAL_SKIN, atol=8)
    np.testing.assert_allclose(colours[part == "leg.R"].mean(axis=0), NEUTRAL_TROUSERS, atol=8)


def test_only_skin_seen_does_not_spread_skin_over_the_clothes(
    body: CapsuleBody, surface: Surface, texels: TexelMap, rest: np.ndarray
) -> None:
    part = part_of(body, surface, texels)
    colours = np.tile([200.0, 20, 60], (len(part), 1))
    filled = fill_atlas(observe(texels, colours, part == "head"), surface, texels, rest)
    legs = filled.rgb.reshape(-1, 3)[texels.flat][part == "leg.L"].astype(float)
    np.testing.assert_allclose(legs.mean(axis=0), NEUTRAL_TROUSERS, atol=8)


def test_one_seen_texel_colours_its_own_part_and_no_other(
    body: CapsuleBody, surface: Surface, texels: TexelMap, rest: np.ndarray
) -> None:
    colours = np.tile([200.0, 20, 60], (len(texels.face), 1))
    part = part_of(body, surface, texels)
    seen = np.zeros(len(texels.face), dtype=bool)
    seen[np.flatnonzero(part == "torso")[500]] = True
    filled = fill_atlas(observe(texels, colours, seen), surface, texels, rest).rgb.reshape(-1, 3)[texels.flat]
    torso, legs = filled[part == "torso"].astype(float), filled[part == "leg.L"].astype(float)
    np.testing.assert_allclose(torso, np.tile([200.0, 20, 60], (len(torso), 1)), atol=15)
    np.testing.assert_allclose(legs, np.tile(NEUTRAL_TROUSERS, (len(legs), 1)), atol=1)


def test_an_unseen_right_hand_takes_the_colours_of_the_left(
    body: CapsuleBody, surface: Surface, texels: TexelMap, rest: np.ndarray
) -> None:
    points = texels.points(rest, surface.faces)
    colours = np.stack(
        [700 * (points[:, 2] - 0.65), 128 + 2000 * points[:, 1], np.full(len(points), 90.0)], axis=1
    ).clip(0, 255)
    part = part_of(body, surface, texels)
    filled = fill_atlas(observe(texels, colours, part == "hand.L"), surface, texels, rest)
    right = part == "hand.R"
    got = filled.rgb.reshape(-1, 3)[texels.flat[right]].astype(float)
    # The nearest opposite texel is up to a texel (about 4 mm at 128) off: 3 levels in z, 8 in y.
    assert np.abs(got - colours[right]).mean() < 4
    without = fill_atlas(observe(texels, colours, part == "hand.L"), surface, texels, rest, fill="harmonic")
    got = without.rgb.reshape(-1, 3)[texels.flat[right]].astype(float)
    assert np.abs(got - colours[right]).mean() > 15


def test_opposite_texels_are_reflections_of_each_other(surface: Surface, texels: TexelMap, rest: np.ndarray) -> None:
    points, normals = texels.points(rest, surface.faces), texel_normals(texels, rest, surface)
    everything, spacing = np.arange(len(points)), np.sqrt(texels.areas(rest, surface).mean())
    opposite = mirror_texels(points, normals, everything, everything, 0.0, spacing)
    assert (opposite >= 0).mean() > 0.99
    found = opposite >= 0
    gap = points[opposite[found]] - points[found] * [-1, 1, 1]
    assert np.quantile(np.linalg.norm(gap, axis=1), 0.95) < 0.01
    assert ((normals[opposite[found]] * (normals[found] * [-1, 1, 1])).sum(axis=1) > 0.5).mean() > 0.99


def test_unseen_hands_and_face_take_the_skin_that_was_seen(
    body: CapsuleBody, surface: Surface, texels: TexelMap, rest: np.ndarray
) -> None:
    points, normals = texels.points(rest, surface.faces), texel_normals(texels, rest, surface)
    part = part_of(body, surface, texels)
    face = (part == "head") & (normals[:, 1] < -0.3)
    colours = np.where(face[:, None], [150.0, 100, 80], [0, 0, 255.0])
    filled = fill_atlas(observe(texels, colours, face | (part == "torso")), surface, texels, rest, light=False)
    assert filled.skin == (150, 100, 80)
    hands = filled.rgb.reshape(-1, 3)[texels.flat][np.char.startswith(part, "hand") & (points[:, 2] < 0.8)]
    np.testing.assert_allclose(hands.astype(float).mean(axis=0), [150, 100, 80], atol=10)


def test_the_back_of_the_clothes_changes_colour_where_the_front_does(
    body: CapsuleBody, surface: Surface, texels: TexelMap, rest: np.ndarray
) -> None:
    points = texels.points(rest, surface.faces)
    colours = np.where(points[:, 2:] > 1.15, [200.0, 20, 20], [20.0, 20, 200])
    front = points[:, 1] < -0.02
    filled = fill_atlas(observe(texels, colours, front), surface, texels, rest, light=False)
    torso = part_of(body, surface, texels) == "torso"
    back = torso & (points[:, 1] > 0.05) & (np.abs(points[:, 2] - 1.15) > 0.1)
    error = np.abs(filled.rgb.reshape(-1, 3)[texels.flat] - colours)[back]
    # Half way between the two colours would be 60 off; this body's vertices are 7 cm apart, so the step is soft.
    assert error.mean() < 20


def test_behind_an_open_collar_there_is_cloth(
    body: CapsuleBody, surface: Surface, texels: TexelMap, rest: np.ndarray
) -> None:
    points = texels.points(rest, surface.faces)
    part = part_of(body, surface, texels)
    skin, shirt = np.array([80.0, 50, 40]), np.array([200.0, 205, 210])
    top = float(points[part == "torso"][:, 2].max())
    open_at = (part == "torso") & (points[:, 2] > top - 0.12) & (np.abs(points[:, 0]) < 0.08)
    colours = np.where((open_at | (part == "head"))[:, None], skin, shirt)
    filled = fill_atlas(observe(texels, colours, points[:, 1] < 0), surface, texels, rest, "harmonic", light=False)
    nape = (part == "torso") & (points[:, 2] > top - 0.12) & (points[:, 1] > 0.06)
    assert filled.rgb.reshape(-1, 3)[texels.flat][nape].mean(0)[0] > 150


def test_the_back_of_the_head_takes_the_colour_of_its_top_not_of_the_face(
    body: CapsuleBody, surface: Surface, texels: TexelMap, rest: np.ndarray
) -> None:
    points = texels.points(rest, surface.faces)
    head = part_of(body, surface, texels) == "head"
    colours = np.where(points[:, 2:] > 1.66, [40.0, 30, 20], [220.0, 170, 150])
    filled = fill_atlas(observe(texels, colours, points[:, 1] < -0.02), surface, texels, rest)
    back = filled.rgb.reshape(-1, 3)[texels.flat][head & (points[:, 1] > 0.05)].astype(float)
    to_top, to_face = (np.linalg.norm(np.median(back, axis=0) - tone) for tone in ([40, 30, 20], [220, 170, 150]))
    assert to_top < to_face / 2


def test_the_fill_of_a_smooth_hole_is_close_to_what_was_there(
    surface: Surface, texels: TexelMap, rest: np.ndarray
) -> None:
    points = texels.points(rest, surface.faces)
    colours = smooth_paint(points)
    hole = np.linalg.norm(points - [0.0, -0.11, 1.15], axis=1) < 0.1
    assert hole.sum() > 40
    filled = fill_atlas(observe(texels, colours, ~hole), surface, texels, rest)
    error = np.abs(filled.rgb.reshape(-1, 3)[texels.flat] - colours)[hole]
    assert error.mean() < 5


def test_links_cross_the_seam_of_a_chart_but_not_the_gap_between_parts(
    body: CapsuleBody, surface: Surface, texels: TexelMap, rest: np.ndarray
) -> None:
    points, normals = texels.points(rest, surface.faces), texel_normals(texels, rest, surface)
    pairs = texel_links(texels, points, normals)
    _, cols = np.divmod(texels.flat[pairs], texels.size)
    across_seam = np.abs(cols[:, 0] - cols[:, 1]) > texels.size // 8
    assert across_seam.sum() > texels.size // 4
    part = part_of(body, surface, texels)
    assert (part[pairs[:, 0]] == part[pairs[:, 1]]).mean() > 0.995
    assert np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1).max() < 0.05


@pytest.mark.parametrize("direct", [True, False])
def test_a_chain_between_two_given_ends_becomes_a_straight_line(direct: bool) -> None:
    count = 30
    pairs = np.stack([np.arange(count - 1), np.arange(1, count)], axis=1)
    given = np.zeros((count, 1))
    given[-1] = 290.0
    fixed = np.zeros(count, dtype=bool)
    fixed[[0, -1]] = True
    pull = Pull(np.zeros((count, 1)), np.zeros(count))
    got = solve_links(pairs, np.ones(count - 1), given, fixed, pull, direct=direct)
    np.testing.assert_allclose(got[:, 0], 10.0 * np.arange(count), atol=1.0)


def test_wanted_gradients_are_kept_from_a_single_given_value() -> None:
    pairs = np.stack([np.arange(9), np.arange(1, 10)], axis=1)
    step = -np.arange(9.0)[:, None]  # value[first] - value[second]
    given = np.full((10, 1), 5.0)
    fixed = np.arange(10) == 0
    got = solve_links(pairs, np.ones(9), given, fixed, Pull(np.zeros((10, 1)), np.zeros(10)), step, direct=True)
    np.testing.assert_allclose(np.diff(got[:, 0]), np.arange(9.0), atol=1e-2)
