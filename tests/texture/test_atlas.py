"""The observed atlas: true colours, nothing from occluders or background, and the first write wins."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ahoy_core.texture.atlas import AtlasAccumulator, ObservedAtlas
from ahoy_core.texture.surface import Surface, look
from ahoy_core.texture.texels import TexelMap

from .synthetic import CapsuleBody, K, pictures, smooth_paint, standing


def accumulate(
    body: CapsuleBody,
    texels: TexelMap,
    fit: dict[str, np.ndarray],
    frames: np.ndarray,
    masks: np.ndarray,
    order: list[int] | None = None,
    rule: str = "first",
    boundary_px: float = 2.0,
) -> ObservedAtlas:
    surface = Surface.of(body)
    atlas = AtlasAccumulator(surface, texels, rule)
    for t in range(len(frames)) if order is None else order:
        posed = body(*(torch.as_tensor(a)[None] for a in (fit["pose"][t], fit["betas"], fit["transl"][t]))).vertices[0]
        seen = look(surface, posed.numpy(), fit["viewmat"], fit["K"], masks[t], boundary_px=boundary_px)
        atlas.add(t, frames[t], masks[t], seen)
    return atlas.result()


def truth(body: CapsuleBody, surface: Surface, texels: TexelMap) -> np.ndarray:
    return smooth_paint(texels.points(body.rest.numpy(), surface.faces))


def turning(count: int) -> dict[str, np.ndarray]:
    fit = standing(count)
    fit["pose"][:, 0, 2] = np.linspace(-1, 1, count)
    return fit


def seen_texels(observed: ObservedAtlas, texels: TexelMap) -> np.ndarray:
    return observed.coverage.ravel()[texels.flat] > 0


def test_texels_seen_have_the_true_colour_of_their_point(body: CapsuleBody, surface: Surface, texels: TexelMap) -> None:
    fit = turning(5)
    frames, masks = pictures(body, fit, smooth_paint)
    observed = accumulate(body, texels, fit, frames, masks)
    seen = seen_texels(observed, texels)
    assert seen.mean() > 0.25
    error = np.abs(observed.rgb.reshape(-1, 3)[texels.flat] - truth(body, surface, texels))[seen]
    # The paint changes by up to 10 levels a pixel (1.6 cm); a wrong texel, half a pixel or a flipped axis would show.
    assert error.mean() < 0.6
    assert error.max() < 6


def test_texels_turned_away_stay_unobserved(body: CapsuleBody, surface: Surface, texels: TexelMap) -> None:
    fit = standing(1)
    observed = accumulate(body, texels, fit, *pictures(body, fit, smooth_paint))
    behind = texels.points(body.rest.numpy(), surface.faces)[:, 1] > 0.02
    flat = texels.flat[behind]
    assert (observed.coverage.ravel()[flat] == 0).all()
    assert (observed.source_frame.ravel()[flat] == -1).all()
    assert (observed.rgb.reshape(-1, 3)[flat] == 0).all()
    assert not (observed.coverage[~texels.chart] > 0).any()


def test_coverage_and_source_agree_and_stay_in_range(body: CapsuleBody, texels: TexelMap) -> None:
    fit = turning(3)
    observed = accumulate(body, texels, fit, *pictures(body, fit, smooth_paint))
    assert ((observed.coverage > 0) == (observed.source_frame >= 0)).all()
    assert observed.coverage.min() >= 0 and observed.coverage.max() <= 1


def test_the_first_frame_that_shows_a_texel_decides_whatever_follows(body: CapsuleBody, texels: TexelMap) -> None:
    fit = turning(4)
    frames, masks = pictures(body, fit, smooth_paint)
    for t in range(4):
        frames[t][masks[t] > 0] = 40 * (t + 1)
    observed = accumulate(body, texels, fit, frames, masks)
    seen = observed.source_frame >= 0
    np.testing.assert_array_equal(observed.rgb[seen][:, 0], 40 * (observed.source_frame[seen] + 1))
    for t in range(4):
        alone = accumulate(body, texels, fit, frames, masks, order=[t]).source_frame == t
        earlier = np.zeros_like(alone)
        for s in range(t):
            earlier |= accumulate(body, texels, fit, frames, masks, order=[s]).source_frame == s
        np.testing.assert_array_equal(observed.source_frame == t, alone & ~earlier)


def test_best_view_takes_the_squarest_look_at_each_texel_in_any_order(body: CapsuleBody, texels: TexelMap) -> None:
    fit = turning(4)
    frames, masks = pictures(body, fit, smooth_paint)
    # Boundary 0 makes every margin safe, so that angle alone ranks the views.
    best = accumulate(body, texels, fit, frames, masks, rule="best", boundary_px=0)
    shuffled = accumulate(body, texels, fit, frames, masks, order=[2, 0, 3, 1], rule="best", boundary_px=0)
    first = accumulate(body, texels, fit, frames, masks, boundary_px=0)
    np.testing.assert_array_equal(best.rgb, shuffled.rgb)
    assert (best.coverage >= first.coverage - 1e-6).all()
    assert best.coverage.sum() > first.coverage.sum() * 1.02


def test_an_occluder_leaves_none_of_its_colour(body: CapsuleBody, surface: Surface, texels: TexelMap) -> None:
    fit = turning(4)
    frames, masks = pictures(body, fit, smooth_paint, background=(255, 0, 0))
    frames[:, 60:80, 40:90] = (255, 0, 0)
    masks[:, 60:80, 40:90] = 0
    observed = accumulate(body, texels, fit, frames, masks)
    seen = seen_texels(observed, texels)
    error = np.abs(observed.rgb.reshape(-1, 3)[texels.flat] - truth(body, surface, texels))[seen]
    assert error.max() < 6


def test_a_fit_shifted_by_a_pixel_paints_no_background_onto_the_body(body: CapsuleBody, texels: TexelMap) -> None:
    fit = standing(1, distance=3.2)
    frames, masks = pictures(body, fit, lambda p: np.full((len(p), 3), 30.0), background=(255, 255, 255))
    fit["transl"][0, 0] += 3.2 / 250  # one pixel
    observed = accumulate(body, texels, fit, frames, masks)
    assert observed.rgb[observed.coverage > 0].max() <= 31


def test_a_person_thirty_pixels_tall_is_still_observed_in_true_colours(
    body: CapsuleBody, surface: Surface, texels: TexelMap
) -> None:
    fit = standing(1, distance=4.0)
    fit["K"] = K * np.float32([[0.28], [0.28], [1]])
    frames, masks = pictures(body, fit, smooth_paint, size=36)
    rows = np.flatnonzero(masks[0].any(axis=1))
    assert 28 <= rows[-1] - rows[0] + 1 <= 32
    observed = accumulate(body, texels, fit, frames, masks)
    seen = seen_texels(observed, texels)
    assert seen.mean() > 0.1
    error = np.abs(observed.rgb.reshape(-1, 3)[texels.flat] - truth(body, surface, texels))[seen]
    # A pixel is 6 cm here, and the paint changes by up to 36 levels across it.
    assert error.mean() < 8


def test_parts_below_the_confidence_asked_for_are_not_written(
    body: CapsuleBody, surface: Surface, texels: TexelMap
) -> None:
    fit = standing(1)
    frames, masks = pictures(body, fit, smooth_paint)
    posed = body(*(torch.as_tensor(a)[:1] for a in (fit["pose"], fit["betas"][None], fit["transl"]))).vertices[0]
    atlas = AtlasAccumulator(surface, texels)
    doubtful = np.where(body.parts == "leg.L", 0.1, 0.9)
    atlas.add(0, frames[0], masks[0], look(surface, posed.numpy(), fit["viewmat"], K, masks[0]), doubtful, 0.5)
    seen = seen_texels(atlas.result(), texels)
    part = body.parts[surface.faces[texels.face, 0]]
    assert not seen[part == "leg.L"].any()
    assert seen[part == "leg.R"].any()


@pytest.mark.parametrize("hidden", ["mask", "behind"])
def test_a_frame_that_shows_nothing_writes_nothing(body: CapsuleBody, texels: TexelMap, hidden: str) -> None:
    fit = standing(1)
    frames, masks = pictures(body, fit, smooth_paint)
    if hidden == "mask":
        masks[:] = 0
    else:
        fit["transl"][0, 1] = -4.0
    assert (accumulate(body, texels, fit, frames, masks).coverage == 0).all()
