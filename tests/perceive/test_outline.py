"""Outlines: what masks say about shape and pose, and what they must not be taken for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from ahoy_core.body.packaged import PackagedBody
from ahoy_core.body.phenotype import BETA_NAMES
from ahoy_core.perceive.edges import find_edges, make_skin
from ahoy_core.perceive.fill import fill_triangles
from ahoy_core.perceive.fit import Fit, fit_body
from ahoy_core.perceive.objective import STATURE, FitConfig
from ahoy_core.perceive.outline import Outline, outline_offsets, outline_rows
from ahoy_core.perceive.priors import build_prior
from ahoy_core.perceive.reduced import ReducedBody, reduce_body
from ahoy_core.perceive.residuals import person_depth
from ahoy_core.perceive.state import State, linearise
from tests.perceive.synthetic import Scene, average_betas, camera, draw_masks, make_scene

WEIGHT = BETA_NAMES.index("weight")
EVERYTHING_SEEN = torch.ones(2, 33).double()


def heavy(body: PackagedBody) -> Scene:
    betas = average_betas(body)
    betas[WEIGHT] = 0.95
    return make_scene(body, frames=2, betas=betas, rise=0.0)


def average(body: PackagedBody) -> Scene:
    return make_scene(body, frames=2, rise=0.0)


def area(body: PackagedBody, scene: Scene, fit: Fit) -> float:
    """Pixels of the fitted body's silhouette, mean over the frames."""
    fitted = replace(scene, pose=fit.pose, transl=fit.transl, betas=fit.betas)
    return float((draw_masks(body, fitted) > 127).sum(axis=(1, 2)).mean())


def apart(body: PackagedBody, scene: Scene, fit: Fit) -> float:
    """Pixels that are in one of the true and the fitted silhouette, mean over the frames."""
    fitted = replace(scene, pose=fit.pose, transl=fit.transl, betas=fit.betas)
    return float(((draw_masks(body, fitted) > 127) != (draw_masks(body, scene) > 127)).sum(axis=(1, 2)).mean())


def true_state(body: PackagedBody, scene: Scene) -> tuple[ReducedBody, State]:
    """The scene as a state of the fit (its moving joints are all that it turns)."""
    betas = scene.betas.double()
    prior = build_prior(body, betas)
    reduced = reduce_body(body, prior.free, betas)
    n = len(scene.pose)
    root = torch.eye(3).double().repeat(n, 1, 1)
    angles = scene.pose[:, list(reduced.free)].double()
    place = scene.transl.double() + reduced.rest_joints(betas)[0]
    return reduced, State(root, angles, place, betas, torch.zeros(()).double())


def edges(body: PackagedBody, scene: Scene, masks: NDArray[np.uint8]) -> tuple[Outline, Tensor]:
    """The edges found from the true state, and the distances to them."""
    reduced, state = true_state(body, scene)
    seen = EVERYTHING_SEEN[: len(masks)]
    found = find_edges(reduced, make_skin(body, reduced), state, masks, seen, camera().double())
    landmarks, _ = state.posed(reduced)
    return found, outline_offsets(reduced, state, found, camera().double(), person_depth(landmarks))


def test_the_true_body_lies_on_the_edges_of_its_own_masks(body: PackagedBody) -> None:
    scene = average(body)
    found, offsets = edges(body, scene, draw_masks(body, scene))
    certain = found.weights > 0.1
    assert int(certain.sum(1).min()) > 30
    # A pixel is 5 mm here; vertices of the outline lie within it.
    assert float(offsets[certain].abs().median()) < 0.003
    assert float(offsets[certain].abs().max()) < 0.02


def test_edges_across_the_outline_and_edges_deep_inside_are_not_the_bodys(body: PackagedBody) -> None:
    scene = average(body)
    masks = draw_masks(body, scene)
    whole, _ = edges(body, scene, masks)
    cut = masks.copy()
    cut[:, 200:] = 0
    cut[:, :, 340:] = 0
    found, offsets = edges(body, scene, cut)
    certain = found.weights > 0
    assert 0 < int(certain.sum()) < 0.5 * int((whole.weights > 0).sum())
    assert float(offsets[certain].abs().median()) < 0.003
    assert float(offsets[certain].abs().max()) < 0.045


def test_derivatives_of_outlines_equal_automatic_ones(body: PackagedBody) -> None:
    scene = average(body)
    found, _ = edges(body, scene, draw_masks(body, scene))
    reduced, state = true_state(body, scene)
    state = replace(state, betas=state.betas + 0.03, angles=state.angles + 0.1)
    person = person_depth(linearise(reduced, state).landmarks)
    offsets, rows = outline_rows(reduced, state, found, camera().double(), person)
    leaves = [t.clone().requires_grad_() for t in (state.angles, state.place, state.betas)]
    moved = replace(state, angles=leaves[0], place=leaves[1], betas=leaves[2])
    again = outline_offsets(reduced, moved, found, camera().double(), person)
    torch.testing.assert_close(again, offsets)
    for frame, place in ((0, 5), (1, 20), (0, 30)):
        automatic = torch.autograd.grad(again[frame, place], leaves, retain_graph=True)
        expected = torch.cat([automatic[0][frame].flatten(), automatic[1][frame], automatic[2], torch.zeros(1)])
        torch.testing.assert_close(rows[frame, place], expected.to(rows), atol=1e-9, rtol=1e-7)


def test_a_heavier_bodys_masks_make_the_fit_heavier(body: PackagedBody) -> None:
    scene = heavy(body)
    # Landmarks lie where a person of average weight has them, so that only the masks tell.
    slim = make_scene(body, frames=2, rise=0.0).seen
    blind = fit_body(body, slim, FitConfig(iterations=6))
    fit = fit_body(body, slim, FitConfig(iterations=6), masks=draw_masks(body, scene))
    # .66 was measured: muscle, which widens too, takes a part.
    assert float(fit.betas[WEIGHT]) > 0.6 > float(blind.betas[WEIGHT])
    assert apart(body, scene, fit) < 0.75 * apart(body, scene, blind)
    assert area(body, scene, fit) > area(body, scene, blind)


def test_something_in_front_does_not_make_the_body_thinner(body: PackagedBody) -> None:
    scene = heavy(body)
    masks = draw_masks(body, scene)
    blind = fit_body(body, scene.seen, FitConfig(iterations=6))
    hidden = masks.copy()
    hidden[:, 200:260] = 0
    hidden[:, :, :330] = 0
    fit = fit_body(body, scene.seen, FitConfig(iterations=6), masks=hidden)
    assert area(body, scene, fit) > 0.995 * area(body, scene, blind)


def test_empty_masks_and_a_weight_of_zero_leave_the_fit_as_it_is(body: PackagedBody) -> None:
    scene = average(body)
    masks = draw_masks(body, scene)
    plain = fit_body(body, scene.seen, FitConfig(iterations=6))
    for fit in (
        fit_body(body, scene.seen, FitConfig(iterations=6), masks=np.zeros_like(masks)),
        fit_body(body, scene.seen, FitConfig(iterations=6, outline=0.0), masks=masks),
    ):
        assert torch.equal(fit.betas, plain.betas) and torch.equal(fit.pose, plain.pose)


def test_one_frame_with_its_mask_is_enough(body: PackagedBody) -> None:
    betas = average_betas(body)
    betas[WEIGHT] = 0.95
    scene = make_scene(body, frames=1, betas=betas, rise=0.0)
    fit = fit_body(body, scene.seen, FitConfig(iterations=6), masks=draw_masks(body, scene))
    assert float(fit.betas[WEIGHT]) > 0.7
    assert all(bool(torch.isfinite(t).all()) for t in (fit.pose, fit.transl, fit.betas))


def test_another_number_of_masks_is_an_error_that_says_so(body: PackagedBody) -> None:
    with pytest.raises(ValueError, match="one mask for each of 2 frames, got 3"):
        fit_body(body, average(body).seen, FitConfig(iterations=6), masks=np.zeros((3, 8, 8), np.uint8))


def test_depth_without_a_scale_of_its_own_follows_average_stature(body: PackagedBody) -> None:
    scene = average(body)
    fit = fit_body(body, replace(scene.seen, world=0.85 * scene.seen.world), FitConfig(iterations=6))
    rest = body.shape(fit.betas[None])[0][0]
    assert abs(float(rest[:, 2].max() - rest[:, 2].min()) - STATURE) < 0.05
    # Size carries depth with it; without the prior on stature both follow the network's metre halfway, 0.3 m.
    assert float((fit.transl - scene.transl)[:, 1].abs().max()) < 0.2


def test_filled_pixels_are_those_whose_centres_lie_in_a_triangle() -> None:
    draw = np.random.default_rng(0)
    for _ in range(20):
        points = draw.uniform(-5, 25, (3, 2))
        canvas = np.zeros((16, 20), np.uint8)
        fill_triangles(canvas, points, np.array([[0, 1, 2]]))
        x, y = np.meshgrid(np.arange(20) + 0.5, np.arange(16) + 0.5)
        system = np.vstack([points.T, np.ones(3)])
        inside = np.linalg.solve(system, np.stack([x.ravel(), y.ravel(), np.ones(x.size)])).min(0) >= 0
        np.testing.assert_array_equal(canvas > 0, inside.reshape(16, 20))
