"""Consensus: what passes before a person for a moment is not theirs."""

from __future__ import annotations

import numpy as np
import pytest

from ahoy_core.texture.consensus import Votes
from ahoy_core.texture.inputs import TextureConfig
from ahoy_core.texture.texture import build_texture

from .synthetic import CapsuleBody, pictures, smooth_paint, standing


@pytest.mark.parametrize("when", [0, 2, 4])
def test_a_ball_that_the_mask_took_for_the_person_leaves_no_colour(body: CapsuleBody, when: int) -> None:
    fit = standing(5)
    frames, masks = pictures(body, fit, lambda points: np.full((len(points), 3), 60.0))
    frames[when, 50:70, 56:72] = 255
    config = TextureConfig(
        atlas_size=64, canonical_height=32, canonical_width=24, align_px=0, rule="first", drop_stains=False
    )
    clean, naive = (
        build_texture(
            frames,
            masks,
            fit,
            body,
            config.model_copy(update={"outlier_levels": levels}),
            canonical=body.rest.numpy(),
        )
        for levels in (50.0, 0.0)
    )
    assert clean.observed_rgb.max() <= 61
    assert (naive.observed_rgb.max() > 200) == (when == 0)
    np.testing.assert_array_equal(clean.coverage > 0, naive.coverage > 0)


def test_the_median_is_one_of_the_votes_or_between_them_and_counts_each_texel_by_itself() -> None:
    votes = Votes(3, 4)
    for texel, value in (([0, 1], 10), ([0], 200), ([0], 30)):
        votes.add(np.array(texel), np.full((len(texel), 3), value, dtype=np.uint8))
    consensus = votes.consensus(np.zeros((3, 3)), 15.0)
    assert consensus.rgb[:2, 0].tolist() == [30, 10]
    assert consensus.votes.tolist() == [3, 1, 0]


def test_a_colour_is_refused_by_a_majority_or_where_nothing_near_looks_like_it() -> None:
    votes = Votes(3, 3)
    for texel in ([0, 1, 2], [0, 1, 2], [0]):
        votes.add(np.array(texel), np.full((len(texel), 3), 50, dtype=np.uint8))
    points = np.array([[0.0, 0, 0], [0.05, 0, 0], [1.0, 0, 0]])  # the third is far from anything settled
    far, near = np.full((3, 3), 120, dtype=np.uint8), np.full((3, 3), 80, dtype=np.uint8)
    consensus = votes.consensus(points, 40.0)
    assert consensus.agrees(np.arange(3), far).tolist() == [False, False, True]
    assert consensus.agrees(np.arange(3), near).tolist() == [True, True, True]


def test_the_median_rule_takes_the_frame_nearest_to_what_most_show(body: CapsuleBody) -> None:
    """A shadow that passes over the person, in the first frame above all, is in no texel that three frames show."""
    fit = standing(5)
    frames, masks = pictures(body, fit, smooth_paint)
    shaded = frames.copy()
    shaded[0] = (0.8 * shaded[0]).astype(np.uint8)
    shaded[3, :64] = (0.85 * shaded[3, :64]).astype(np.uint8)
    errors = {}
    for rule in ("first", "median"):
        config = TextureConfig(
            atlas_size=64, canonical_height=32, canonical_width=24, align_px=0, rule=rule, exposure="off"
        )
        made = build_texture(shaded, masks, fit, body, config, canonical=body.rest.numpy())
        clean = build_texture(frames, masks, fit, body, config, canonical=body.rest.numpy())
        assert set(np.unique(made.source_frame)) <= set(range(-1, 5))
        seen = made.coverage > 0
        errors[rule] = np.abs(made.observed_rgb[seen].astype(float) - clean.observed_rgb[seen]).mean()
    assert errors["first"] > 10
    assert errors["median"] == 0
