"""The corrector of landmarks: what must hold whatever it has learned."""

from __future__ import annotations

from importlib import resources

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from ahoy_core.body.packaged import PackagedBody
from ahoy_core.perceive.corrector import ASSET, MIRROR, SPREADS, Corrected, correct, weak_perspective
from tests.perceive.synthetic import make_scene

Seen = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]
FLIP2, FLIP3 = np.array([-1.0, 1.0]), np.array([-1.0, 1.0, 1.0])


@pytest.fixture(scope="module")
def seen(body: PackagedBody) -> Seen:
    """Points, world in camera axes, visibility with hidden legs, and K."""
    scene = make_scene(body, 4, rise=0.0).seen
    world = scene.world.double().numpy()
    camera = np.stack([world[..., 0], -world[..., 2], world[..., 1]], axis=-1)
    visibility = np.full((4, 33), 0.98)
    visibility[:, 25:] = 0.5
    return scene.points.double().numpy(), camera, visibility, scene.K.double().numpy()


def close(a: Corrected, points: NDArray[np.float64], world: NDArray[np.float64]) -> None:
    # Float32 of the network, in pixels and metres.
    np.testing.assert_allclose(a.points, points, atol=0.02)
    np.testing.assert_allclose(a.world, world, atol=1e-4)


def test_a_mirrored_video_is_corrected_in_the_mirror(seen: Seen) -> None:
    points, world, visibility, K = seen
    width, order = 2 * K[0, 2], list(MIRROR)
    up = np.array([0.1, -0.95, -0.2])
    plain = correct(points, world, visibility, K, up)
    turned = correct(
        points[:, order] * FLIP2 + [width, 0], world[:, order] * FLIP3, visibility[:, order], K, up * FLIP3
    )
    close(turned, plain.points[:, order] * FLIP2 + [width, 0], plain.world[:, order] * FLIP3)
    np.testing.assert_allclose(turned.image_spread, plain.image_spread[:, order], rtol=1e-3)


def test_the_size_of_the_picture_does_not_matter(seen: Seen) -> None:
    points, world, visibility, K = seen
    double = K * np.array([[2.0], [2.0], [1.0]])
    plain, large = correct(points, world, visibility, K), correct(2 * points, world, visibility, double)
    close(large, 2 * plain.points, plain.world)


def test_hidden_landmarks_are_trusted_less(seen: Seen) -> None:
    points, world, visibility, K = seen
    hidden = correct(points, world, visibility, K)
    shown = correct(points, world, np.full_like(visibility, 0.99), K)
    legs = slice(25, 33)
    assert hidden.image_spread[:, legs].mean() > 1.2 * shown.image_spread[:, legs].mean()


def test_what_was_never_seen_in_training_moves_nothing_far(seen: Seen) -> None:
    points, world, visibility, K = seen
    for wild in (1e4 * points, np.zeros_like(points), points + 1e6):
        answer = correct(wild, 100 * world, visibility, K)
        for values in (answer.points, answer.world, answer.image_spread, answer.world_spread):
            assert np.isfinite(values).all()
        assert answer.image_spread.min() >= SPREADS[0] - 1e-6 and answer.image_spread.max() <= SPREADS[1] + 1e-6


def test_a_person_seen_end_on_has_a_scale(seen: Seen) -> None:
    points, world, visibility, _ = seen
    rays = torch.from_numpy(points / 700).float()
    flat = torch.from_numpy(world).float() * torch.tensor([1e-9, 1e-9, 1.0])
    frame = weak_perspective(rays, flat, torch.from_numpy(visibility).float())
    assert bool((frame.scale > 0).all()) and bool(torch.isfinite(frame.to_metres(rays)).all())


def test_the_asset_is_small() -> None:
    assert resources.files("ahoy_core.assets").joinpath(ASSET).stat().st_size < 2e6  # type: ignore[attr-defined]
