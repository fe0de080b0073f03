from __future__ import annotations

import numpy as np
import pytest
import trimesh

from ahoy_core.maps.charts import Chart, Packer, Surface, view_charts


def _sphere(radius: float, center: tuple[float, float, float] = (0, 0, 0)) -> trimesh.Trimesh:
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    mesh.apply_translation(center)
    return mesh


def _surface(*meshes: trimesh.Trimesh) -> Surface:
    mesh = trimesh.util.concatenate(meshes)
    return Surface.of(np.asarray(mesh.vertices), np.asarray(mesh.faces))


def _square(size: int, seed: int = 0) -> Chart:
    rows, cols = (g.ravel() for g in np.mgrid[:size, :size])
    count = size * size
    points = np.random.default_rng(seed).random((count, 3))
    return Chart(rows, cols, points, np.zeros(count, int), np.full((count, 3), 1 / 3), np.zeros((count, 3)))


@pytest.mark.parametrize("view", ["front", "back", "left", "right", "below", "above"])
def test_a_view_of_a_sphere_sees_its_half(view: str):
    surface = _surface(_sphere(0.5))
    charts = view_charts(surface, view, pitch=0.02)
    assert len(charts) == 1
    chart = charts[0]
    assert (np.einsum("ij,ij->i", chart.points, chart.rays) < 1e-6).all()
    assert len(chart) == pytest.approx(np.pi * 25**2, rel=0.02)
    assert np.allclose(np.linalg.norm(chart.points, axis=1), 0.5, atol=2e-3)


def test_what_stands_behind_is_the_second_layer_and_the_inside_is_none():
    surface = _surface(_sphere(0.3), _sphere(0.2, (0, 2, 0)))
    near, far = view_charts(surface, "front", pitch=0.02)
    assert near.points[:, 1].max() < 0.01
    assert far.points[:, 1].min() > 1.7 and far.points[:, 1].max() < 2.01


def test_front_is_seen_as_in_a_photograph():
    surface = _surface(_sphere(0.2), _sphere(0.1, (0.6, 0, 0.6)))
    chart = view_charts(surface, "front", pitch=0.02)[0]
    hand = chart.points[:, 0] > 0.45
    assert chart.cols[hand].min() > chart.cols[~hand].max()
    assert chart.rows[hand].max() < chart.rows[~hand].min()


def test_packed_charts_do_not_overlap_and_stay_inside():
    packer = Packer(2, 32)
    pixels = np.concatenate([packer.fit(_square(size, size)) for size in (20, 15, 11, 11, 7)])
    assert (pixels >= 0).all()
    assert (pixels[:, 1:] < 32).all()
    assert len(np.unique(pixels, axis=0)) == len(pixels) == 2 * 32 * 32 - packer.free


def test_a_chart_that_fits_stays_in_one_piece():
    packer = Packer(1, 32)
    pixels = packer.fit(_square(20))
    assert np.ptp(pixels[:, 1]) == 19 and np.ptp(pixels[:, 2]) == 19


def test_a_chart_too_large_is_cut_and_the_rest_marked():
    packer = Packer(1, 16)
    pixels = packer.fit(_square(20))
    assert packer.free == 0
    assert (pixels[:, 0] >= 0).sum() == 16 * 16


def test_taken_pixels_are_refused():
    packer = Packer(1, 16)
    packer.put(_square(4), 0, 0, 0)
    with pytest.raises(ValueError, match="expected free pixels"):
        packer.put(_square(4), 0, 3, 3)
    with pytest.raises(ValueError, match="expected free pixels"):
        packer.put(_square(4), 0, 13, 3)
