"""The light on a person: found where what was seen tells, believed where it does not, and never copied as colour."""

from __future__ import annotations

import numpy as np
import pytest

from ahoy_core.texture.fill import fill_atlas
from ahoy_core.texture.light import BEHIND, BRIGHTEST, DARKEST, estimate_light, shading
from ahoy_core.texture.parts import HEAD_PART, LEG_PART, TRUNK_PART
from ahoy_core.texture.surface import Surface
from ahoy_core.texture.texels import TexelMap, texel_normals

from .synthetic import CapsuleBody
from .test_fill import observe, part_of

CLOTH = np.array([120.0, 90, 70])


@pytest.fixture(scope="module")
def rest(body: CapsuleBody) -> np.ndarray:
    return body.rest.numpy()


def balls(count: int = 4000, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Normals [N,3] all round, areas [N], and two parts [N]."""
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(count, 3))
    return normals / np.linalg.norm(normals, axis=1, keepdims=True), np.ones(count), rng.integers(0, 2, count)


@pytest.mark.parametrize("slope", [(0.3, -0.1, 0.1), (-0.2, 0.25, 0.0), (0.0, 0.0, 0.0)])
def test_light_is_found_on_one_who_was_seen_all_round(slope: tuple[float, float, float]) -> None:
    normals, areas, part = balls()
    own = np.where(part[:, None] == LEG_PART, CLOTH, 2 * CLOTH)
    colours = own * (1 + normals @ np.array(slope))[:, None]
    found = estimate_light(colours, normals, areas, part, np.ones(len(part), dtype=bool))
    # A belief that nothing is known of weighs a tenth against the third that a sphere's normals have in each direction.
    np.testing.assert_allclose(found, np.array(slope) / (1 + 0.3), atol=0.03)


def test_prints_and_folds_do_not_count_as_light() -> None:
    normals, areas, part = balls()
    colours = CLOTH * (1 + 0.3 * normals[:, :1])
    colours[normals[:, 2] > 0.7] = 250  # a white collar
    found = estimate_light(colours, normals, areas, part, np.ones(len(part), dtype=bool))
    assert found[0] == pytest.approx(0.23, abs=0.04)
    assert abs(found[2]) < 0.06


def test_who_was_seen_from_the_front_alone_is_believed_darker_behind() -> None:
    normals, areas, part = balls()
    flat = np.tile(CLOTH, (len(part), 1))
    front = normals[:, 1] < 0
    found = estimate_light(flat, normals, areas, part, front)
    assert -BEHIND < found[1] < -0.3 * BEHIND
    np.testing.assert_allclose(found[[0, 2]], 0, atol=0.02)
    turned = estimate_light(flat, normals * [1, -1, 1], areas, part, front)
    np.testing.assert_allclose(turned, found * [1, -1, 1], atol=1e-9)


def test_too_little_cloth_says_nothing() -> None:
    normals, areas, part = balls()
    colours = CLOTH * (1 + 0.3 * normals[:, :1])
    few = np.arange(len(part)) < 50
    np.testing.assert_array_equal(estimate_light(colours, normals, areas, part, few), 0)
    skin = np.full(len(part), HEAD_PART)
    np.testing.assert_array_equal(estimate_light(colours, normals, areas, skin, np.ones(len(part), dtype=bool)), 0)


def test_black_clothes_and_nothing_at_all_are_no_trouble() -> None:
    normals, areas, part = balls()
    everything = np.ones(len(part), dtype=bool)
    for colours in (np.zeros((len(part), 3)), np.full((len(part), 3), 255.0)):
        assert np.isfinite(estimate_light(colours, normals, areas, part, everything)).all()
    np.testing.assert_array_equal(estimate_light(np.zeros((0, 3)), normals[:0], areas[:0], part[:0], everything[:0]), 0)


def test_shading_stays_within_its_bounds() -> None:
    normals, _, _ = balls()
    bright = shading(normals, np.array([0.0, 5.0, 0.0]))
    assert bright.min() == DARKEST
    assert bright.max() == BRIGHTEST
    np.testing.assert_array_equal(shading(normals, np.zeros(3)), 1)


@pytest.mark.parametrize("fill", ["both", "harmonic", "symmetric"])
def test_the_unlit_side_is_filled_darker_than_the_lit_one_it_is_copied_from(
    body: CapsuleBody, surface: Surface, texels: TexelMap, rest: np.ndarray, fill: str
) -> None:
    normals = texel_normals(texels, rest, surface)
    part = part_of(body, surface, texels)
    truth = CLOTH * np.clip(1 + normals @ np.array([0.3, -0.25, 0.0]), DARKEST, BRIGHTEST)[:, None]
    seen = (normals[:, 1] < -0.2) & (part != "arm.R")
    hidden = ~seen & np.isin(part, ("torso", "arm.R", "leg.R"))

    def error(light: bool) -> float:
        filled = fill_atlas(observe(texels, truth, seen), surface, texels, rest, fill, light=light)
        return float(np.abs(filled.rgb.reshape(-1, 3)[texels.flat] - truth)[hidden].mean())

    assert error(True) < 0.6 * error(False)


def test_seen_texels_stay_as_they_were_seen(surface: Surface, texels: TexelMap, rest: np.ndarray) -> None:
    normals = texel_normals(texels, rest, surface)
    rng = np.random.default_rng(0)
    colours = rng.uniform(0, 255, (len(normals), 3)) * np.clip(1 + 0.4 * normals[:, :1], 0, 1)
    observed = observe(texels, colours, normals[:, 1] < 0)
    filled = fill_atlas(observed, surface, texels, rest)
    assert np.abs(filled.light).max() > 0.05
    where = observed.coverage > 0
    np.testing.assert_array_equal(filled.rgb[where], observed.rgb[where])


def test_a_part_that_was_not_seen_takes_no_part_in_the_estimate() -> None:
    normals, areas, part = balls()
    colours = CLOTH * (1 + 0.3 * normals[:, :1])
    seen = part == TRUNK_PART
    colours[~seen] = np.nan
    assert np.isfinite(estimate_light(colours, normals, areas, part, seen)).all()
