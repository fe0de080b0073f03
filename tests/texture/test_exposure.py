"""A wandering exposure leaves no steps in the atlas."""

from __future__ import annotations

import numpy as np
import pytest

from ahoy_core.texture.exposure import match_exposure
from ahoy_core.texture.inputs import TextureConfig
from ahoy_core.texture.texels import texel_map
from ahoy_core.texture.texture import build_texture

from .synthetic import CapsuleBody, Surface, pictures, smooth_paint, standing


def colours(count: int = 3000, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(20, 200, (count, 3))


def test_a_gain_is_found_though_a_quarter_of_the_colours_is_something_else() -> None:
    known = colours()
    seen = known * [0.8, 1.0, 1.2]
    seen[::4] = 40.0
    found = match_exposure(seen, known, "gain")
    assert found is not None
    np.testing.assert_allclose(found.gain, [1 / 0.8, 1, 1 / 1.2], rtol=0.04)
    np.testing.assert_array_equal(found.gamma, 1)


def test_gain_and_gamma_are_found_and_undo_the_drift() -> None:
    known = colours()
    seen = 255 * 0.9 * (known / 255) ** 1.2
    found = match_exposure(seen, known, "gamma")
    assert found is not None
    np.testing.assert_allclose(found.gamma, 1 / 1.2, rtol=0.02)
    image = np.rint(seen).astype(np.uint8).reshape(30, 100, 3)
    # Rounding to levels twice, and once more through a gain of up to 1.2.
    assert np.abs(found.apply(image).reshape(-1, 3) - known).max() < 4


@pytest.mark.parametrize(
    "seen", [colours() * 1.02, np.full((3000, 3), 255.0), np.zeros((3000, 3)), colours()[:100] * 1.3], ids=str
)
def test_shading_clipped_colours_and_too_few_of_them_change_nothing(seen: np.ndarray) -> None:
    assert match_exposure(seen, colours()[: len(seen)], "gain") is None


def test_exposures_out_of_a_cameras_range_are_not_believed() -> None:
    found = match_exposure(colours() * 0.2 + 11, colours(), "gain")
    assert found is not None and found.gain.max() <= 2


def test_a_drifting_clip_gives_the_colours_of_its_middle_exposure() -> None:
    body = CapsuleBody()
    fit = standing(9)
    fit["pose"][:, 0, 2] = np.linspace(-1.2, 1.2, 9)
    frames, masks = pictures(body, fit, smooth_paint)
    gains = np.array([0.75, 1.25, 1, 0.8, 1, 1.2, 1, 0.85, 1.15])
    drifted = np.clip(np.rint(frames * gains[:, None, None, None]), 0, 255).astype(np.uint8)
    surface = Surface.of(body)
    texels = texel_map(surface, 128)
    truth = smooth_paint(texels.points(body.rest.numpy(), surface.faces))
    errors = {}
    for mode in ("off", "gain"):
        config = TextureConfig(atlas_size=128, canonical_height=32, canonical_width=24, exposure=mode, align_px=0)
        texture = build_texture(drifted, masks, fit, body, config, canonical=body.rest.numpy())
        seen = texture.coverage.ravel()[texels.flat] > 0
        errors[mode] = np.abs(texture.observed_rgb.reshape(-1, 3)[texels.flat] - truth)[seen].mean()
    assert errors["gain"] < 0.4 * errors["off"]
