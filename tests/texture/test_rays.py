"""Rays: a pixel sees the point that projects onto it, from any camera and any distance from the origin."""

from __future__ import annotations

import numpy as np
import pytest

from ahoy_core.texture.rays import Caster, hit_map, to_camera, to_pixels

from .synthetic import K

TRIANGLES = np.array([[0, 1, 2], [3, 4, 5]])


def two_walls(z_near: float = 2.0, z_far: float = 3.0) -> np.ndarray:
    """Two large triangles that face the camera, the nearer one on the left half only."""
    far = [[-5, -5, z_far], [0, 5, z_far], [5, -5, z_far]]
    near = [[-5, -5, z_near], [-5, 5, z_near], [-0.01, 0, z_near]]
    return np.array(near + far, dtype=np.float64)


@pytest.mark.parametrize("model", ["pinhole", "ortho"])
def test_a_pixel_sees_the_point_that_projects_to_its_centre(model: str) -> None:
    intrinsics = K if model == "pinhole" else np.array([[40.0, 0, 64], [0, 40.0, 64], [0, 0, 1]])
    vertices = two_walls()
    caster = Caster(vertices, TRIANGLES, model)
    hits = hit_map(caster, intrinsics, 128, 128)
    rows, cols = np.nonzero(hits.face >= 0)
    assert len(rows) > 1000
    points = (vertices[TRIANGLES[hits.face[rows, cols]]] * hits.bary[rows, cols][:, :, None]).sum(axis=1)
    # float32 rays: a thousandth of a pixel
    np.testing.assert_allclose(to_pixels(points, intrinsics, model), np.stack([cols, rows], axis=1) + 0.5, atol=1e-3)
    np.testing.assert_allclose(hits.depth[rows, cols], points[:, 2], atol=1e-4)


def test_the_nearer_layer_hides_the_farther_one() -> None:
    caster = Caster(two_walls(), TRIANGLES)
    behind = np.array([[-0.3, 0.0, 3.0], [0.3, 0.0, 3.0]])
    assert caster.sees(behind, np.array([1, 1])).tolist() == [False, True]


def test_a_wall_turned_away_has_a_negative_cosine() -> None:
    hits = hit_map(Caster(two_walls(), TRIANGLES[:, ::-1]), K, 128, 128)
    assert (hits.cosine[hits.face >= 0] < 0).all()


def test_a_person_far_from_the_origin_is_hit_as_precisely_as_one_near_it() -> None:
    shift = np.array([1e5, -2e5, 3e4])
    view = np.eye(4)
    view[:3, 3] = -shift
    near = hit_map(Caster(two_walls(), TRIANGLES), K, 64, 64)
    far = hit_map(Caster(to_camera(two_walls() + shift, view), TRIANGLES), K, 64, 64)
    np.testing.assert_array_equal(near.face, far.face)
    np.testing.assert_allclose(near.bary, far.bary, atol=1e-5)


def test_a_body_behind_the_camera_or_beside_the_image_is_not_seen() -> None:
    assert (hit_map(Caster(two_walls(-3, -2), TRIANGLES), K, 64, 64).face == -1).all()
    beside = two_walls() + np.array([100.0, 0, 0])
    assert (hit_map(Caster(beside, TRIANGLES), K, 64, 64).face == -1).all()


def test_a_body_that_straddles_the_camera_plane_gives_finite_depths_where_hit() -> None:
    vertices = two_walls()
    vertices[0, 2] = -1.0
    hits = hit_map(Caster(vertices, TRIANGLES), K, 64, 64)
    assert (hits.face >= 0).any()
    assert np.isfinite(hits.depth[hits.face >= 0]).all()
    assert np.isfinite(hits.bary).all()


def test_non_finite_vertices_are_refused() -> None:
    vertices = two_walls()
    vertices[0, 0] = np.nan
    with pytest.raises(ValueError, match="finite vertices"):
        Caster(vertices, TRIANGLES)
