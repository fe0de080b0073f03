"""Degenerate clips give complete, finite textures, whatever rule writes and whatever fills."""

from __future__ import annotations

import numpy as np
import pytest

from ahoy_core.texture.inputs import TextureConfig
from ahoy_core.texture.texture import Texture, build_texture

from .synthetic import CapsuleBody, pictures, smooth_paint, standing

SETTINGS = [("first", "both", "gain"), ("best", "harmonic", "off"), ("median", "symmetric", "gamma")]


@pytest.fixture(params=SETTINGS, ids=lambda setting: "-".join(setting))
def config(request: pytest.FixtureRequest) -> TextureConfig:
    rule, fill, exposure = request.param
    return TextureConfig(
        atlas_size=64, canonical_height=32, canonical_width=24, rule=rule, fill=fill, exposure=exposure
    )


def build(
    config: TextureConfig, body: CapsuleBody, frames: np.ndarray, masks: np.ndarray, **changes: object
) -> Texture:
    fit = {**standing(len(frames)), **changes}
    with np.errstate(all="raise", under="ignore"):  # a division by nothing or a NaN cast to a colour would show here
        texture = build_texture(frames, masks, fit, body, config, canonical=body.rest.numpy())
    assert np.isfinite(texture.coverage).all()
    assert np.isfinite([texture.notes[key] for key in ("observed_share", "mirrored_share", "diffused_share")]).all()
    assert (texture.views[..., 3] > 0).any(axis=(1, 2)).all()
    return texture


def test_an_empty_mask_and_one_of_a_single_pixel(config: TextureConfig, body: CapsuleBody) -> None:
    frames, masks = pictures(body, standing(4), smooth_paint)
    assert build(config, body, frames, 0 * masks).notes["observed_share"] == 0
    single = np.zeros_like(masks)
    single[:, 64, 64] = 255
    assert build(config, body, frames, single).notes["observed_share"] < 0.01


@pytest.mark.parametrize("level", [0, 128, 255])
def test_constant_and_saturated_colours_are_seen_as_they_are(
    config: TextureConfig, body: CapsuleBody, level: int
) -> None:
    frames, masks = pictures(body, standing(4), smooth_paint)
    texture = build(config, body, np.full_like(frames, level), masks)
    assert set(texture.observed_rgb[texture.coverage > 0].ravel().tolist()) == {level}


def test_a_frame_whose_fit_is_not_a_number_changes_nothing(config: TextureConfig, body: CapsuleBody) -> None:
    frames, masks = pictures(body, standing(5), smooth_paint)
    frames[2] = 255
    pose = standing(5)["pose"]
    pose[2, 0, 1] = np.nan
    broken = build(config, body, frames, masks, pose=pose)
    used = np.array([True, True, False, True, True])
    without = build(config, body, frames, masks, used=used)
    assert 2 not in broken.source_frame
    np.testing.assert_array_equal(broken.observed_rgb, without.observed_rgb)


def test_one_frame_is_enough(config: TextureConfig, body: CapsuleBody) -> None:
    frames, masks = pictures(body, standing(1), smooth_paint)
    assert build(config, body, frames, masks).notes["observed_share"] > 0.2
