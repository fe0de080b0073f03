"""The shift of a frame against known colours: found where it shows, zero where nothing can be told."""

from __future__ import annotations

import numpy as np
import pytest

from ahoy_core.texture.align import best_shift
from ahoy_core.texture.texels import sample_image


def pattern(seed: int = 0) -> np.ndarray:
    """A smooth random image [64,64,3] uint8."""
    coarse = np.random.default_rng(seed).uniform(0, 255, (10, 10, 3))
    rows, cols = np.mgrid[0:64, 0:64] / 7.5 + 0.5
    return sample_image(coarse, np.stack([cols.ravel(), rows.ravel()], axis=1)).reshape(64, 64, 3).astype(np.uint8)


def inner_pixels(count: int = 1500) -> np.ndarray:
    return np.random.default_rng(1).uniform(10, 54, (count, 2))


@pytest.mark.parametrize("true", [(3.0, -2.0), (-4.0, 4.0), (0.5, 1.5)])
def test_a_shift_is_found_to_half_a_pixel(true: tuple[float, float]) -> None:
    image, pixels = pattern(), inner_pixels()
    colours = sample_image(image, pixels + np.array(true))
    assert np.abs(np.subtract(best_shift(image, pixels, colours, 4.0), true)).max() <= 0.5


def test_a_third_of_foreign_colours_does_not_change_the_shift() -> None:
    image, pixels = pattern(), inner_pixels()
    colours = sample_image(image, pixels + np.array([2.0, 1.0]))
    colours[::3] = (255, 0, 255)
    assert np.abs(np.subtract(best_shift(image, pixels, colours, 4.0), (2.0, 1.0))).max() <= 0.5


def test_no_shift_leaves_its_reach() -> None:
    image, pixels = pattern(), inner_pixels()
    colours = sample_image(image, pixels + np.array([5.0, 0.0]))
    assert np.abs(best_shift(image, pixels, colours, 3.0)).max() <= 3.0


@pytest.mark.parametrize("why", ["flat", "few", "off"])
def test_there_is_no_shift_where_nothing_can_be_told(why: str) -> None:
    image = np.full((64, 64, 3), 90, dtype=np.uint8) if why == "flat" else pattern()
    pixels = inner_pixels(50 if why == "few" else 1500)
    colours = sample_image(image, pixels + np.array([2.0, 0.0])) + (5 if why == "flat" else 0)
    assert best_shift(image, pixels, colours, 0.0 if why == "off" else 4.0) == (0.0, 0.0)
