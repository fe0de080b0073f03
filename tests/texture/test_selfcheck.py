"""Fillings compete on what was hidden from them; the shells of the roles keep their contracts."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
import torch

from ahoy_core.conventions import Cameras
from ahoy_core.roles import COMPLETIONS, FILLINGS
from ahoy_core.texture.canonical import CanonicalViews
from ahoy_core.texture.fill import fill_atlas
from ahoy_core.texture.fillings import TexturedBody
from ahoy_core.texture.selfcheck import patches, score_fillings, side_of
from ahoy_core.texture.surface import Surface
from ahoy_core.texture.texels import TexelMap

from .synthetic import CapsuleBody
from .test_fill import observe


@pytest.fixture(scope="module")
def rest(body: CapsuleBody) -> np.ndarray:
    return body.rest.numpy()


def test_symmetry_wins_on_a_symmetric_person_and_loses_on_one_whose_sides_differ(
    surface: Surface, texels: TexelMap, rest: np.ndarray
) -> None:
    points = texels.points(rest, surface.faces)
    everything = np.ones(len(points), dtype=bool)
    banded = np.where((20 * points[:, 2:]).astype(int) % 2, [200.0, 200, 200], [40.0, 40, 40])
    left = side_of(points, rest, left=True)
    scores = score_fillings(observe(texels, banded, everything), surface, texels, rest, left, COMPLETIONS)
    assert scores["symmetry + harmonic"].l1 < 0.5 * scores["harmonic"].l1
    assert scores["symmetry"].l1 < 0.5 * scores["harmonic"].l1
    halves = np.where(points[:, :1] > 0, [200.0, 30, 30], [30.0, 30, 200])
    seen = ~left | (points[:, 1] < -0.02)
    hidden = left & (points[:, 0] > 0.12) & (points[:, 1] < -0.02)
    scores = score_fillings(observe(texels, halves, seen), surface, texels, rest, hidden, COMPLETIONS)
    assert scores["harmonic"].l1 < scores["symmetry + harmonic"].l1


def test_the_score_is_the_error_of_the_hidden_texels_alone(
    surface: Surface, texels: TexelMap, rest: np.ndarray
) -> None:
    points = texels.points(rest, surface.faces)
    hidden = patches(points, rest, count=3, radius=0.08, rng=np.random.default_rng(1))
    mirrored = points * [-1, 1, 1]
    assert 0 < hidden.mean() < 0.3
    again = patches(mirrored, rest, count=3, radius=0.08, rng=np.random.default_rng(1))
    assert (again == hidden).mean() > 0.99, "patches come in pairs"

    def wrong(*given: object) -> object:
        filled = fill_atlas(*given)  # type: ignore[arg-type]
        filled.rgb[:] = 107
        return filled

    observed = observe(texels, np.full((len(points), 3), 100.0), np.ones(len(points), dtype=bool))
    kept = observed.rgb.copy()
    scores = score_fillings(observed, surface, texels, rest, hidden, {"wrong": wrong, "right": partial(fill_atlas)})
    assert scores["wrong"].l1 == pytest.approx(7)
    assert set(scores["wrong"].by_part.values()) == {7.0}
    assert scores["right"].l1 == pytest.approx(0, abs=1)
    np.testing.assert_array_equal(observed.rgb, kept)


def test_hiding_what_was_never_seen_is_refused(surface: Surface, texels: TexelMap, rest: np.ndarray) -> None:
    nothing = observe(texels, np.zeros((len(texels.face), 3)), np.zeros(len(texels.face), dtype=bool))
    with pytest.raises(ValueError, match="hide another region"):
        score_fillings(nothing, surface, texels, rest, np.ones(len(texels.face), dtype=bool), COMPLETIONS)


def test_the_textured_body_fills_inpaint_and_views_by_their_contracts() -> None:
    rng = np.random.default_rng(0)
    rgba = rng.integers(0, 256, (4, 12, 8, 4)).astype(np.uint8)
    cameras = Cameras(torch.eye(4).repeat(4, 1, 1), torch.eye(3).repeat(4, 1, 1), 8, 12, "ortho")
    person = TexturedBody(CanonicalViews(rgba, rgba[..., 0], rgba[0], cameras))
    image, mask = torch.rand(3, 12, 8), torch.zeros(1, 12, 8)
    mask[:, 3:6] = 1
    filled = FILLINGS["inpaint"]["textured body"](person, image, mask, "a person", 3)
    views, azimuths = FILLINGS["views"]["textured body"](person, image, mask)
    assert torch.equal(filled[:, mask[0] == 0], image[:, mask[0] == 0])
    assert torch.equal(filled[:, mask[0] == 1], views[0][:, mask[0] == 1])
    assert views.shape == (4, 3, 12, 8) and azimuths == (0.0, 90.0, 180.0, 270.0)
    assert float(views.min()) >= 0 and float(views.max()) <= 1
    with pytest.raises(ValueError, match="same camera"):
        person.inpaint(image[:, :5], mask)
