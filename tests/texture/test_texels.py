"""Texels and lookups: the atlas's convention, complete rasterization, no bleeding at chart borders."""

from __future__ import annotations

import numpy as np

from ahoy_core.texture.surface import Surface, interpolate_uv
from ahoy_core.texture.texels import TexelMap, pad_charts, sample_atlas, sample_image, texel_map

from .synthetic import CapsuleBody


def test_each_texel_lies_where_its_barycentrics_say(surface: Surface, texels: TexelMap) -> None:
    uv = interpolate_uv(surface, texels.face, texels.bary)
    rows, cols = np.divmod(texels.flat, texels.size)
    want = np.stack([(cols + 0.5) / texels.size, 1 - (rows + 0.5) / texels.size], axis=1)
    np.testing.assert_allclose(uv, want, atol=1e-5)


def test_every_texel_within_a_chart_is_found(texels: TexelMap) -> None:
    # Charts are rectangles of 0.03 to 0.97 of a cell, a quarter wide and half high.
    centre = (np.arange(texels.size) + 0.5) / texels.size
    across = (centre * 4 % 1 > 0.04) & (centre * 4 % 1 < 0.96)
    down = (centre * 2 % 1 > 0.14) & (centre * 2 % 1 < 0.86)  # the poles' rows are cut to triangles
    assert texels.chart[np.ix_(down, across)].mean() > 0.999


def test_faces_that_are_never_textured_take_no_texel(body: CapsuleBody) -> None:
    inside = CapsuleBody()
    inside.regions = {**body.regions, "interior": body.regions["hands"]}
    surface = Surface.of(inside)
    owners = np.unique(texel_map(surface, 64).face)
    assert surface.textured[owners].all()
    assert not surface.textured.all()


def test_areas_add_up_to_the_surface(body: CapsuleBody, surface: Surface, texels: TexelMap) -> None:
    vertices = body.rest.numpy()
    a, b, c = (vertices[surface.faces[:, i]] for i in range(3))
    total = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
    # Slivers at the poles own no texel: their area is lost, a small share.
    assert abs(texels.areas(vertices, surface).sum() / total - 1) < 0.02


def test_lookup_has_its_origin_at_the_lower_left() -> None:
    atlas = np.zeros((4, 4, 3), dtype=np.uint8)
    atlas[3, 0] = 200  # the picture's lower left corner
    assert sample_atlas(atlas, np.array([[0.125, 0.125]]))[0, 0] == 200
    assert sample_atlas(atlas, np.array([[0.125, 0.875]]))[0, 0] == 0


def test_lookup_reproduces_a_linear_ramp_exactly() -> None:
    rows, cols = np.mgrid[0:8, 0:10] + 0.5
    image = (3 * cols + 7 * rows).astype(np.float32)
    pixels = np.random.default_rng(0).uniform(0.5, 7.5, (50, 2))
    np.testing.assert_allclose(sample_image(image, pixels), 3 * pixels[:, 0] + 7 * pixels[:, 1], atol=1e-4)


def test_a_lookup_anywhere_on_the_surface_never_mixes_in_the_empty_background(
    surface: Surface, texels: TexelMap
) -> None:
    atlas = np.where(texels.chart, 200, 0).astype(np.uint8)
    padded = pad_charts(atlas, texels.chart)
    uv = surface.uvs[surface.uv_faces].reshape(-1, 2)
    assert (sample_atlas(padded, uv) == 200).all()
    assert (sample_atlas(atlas, uv) < 200).any()


def test_padding_keeps_known_texels_and_copies_the_nearest_into_the_others() -> None:
    atlas = np.zeros((5, 5, 3), dtype=np.uint8)
    known = np.zeros((5, 5), dtype=bool)
    atlas[0, 0], known[0, 0] = (10, 20, 30), True
    atlas[4, 4], known[4, 4] = (1, 2, 3), True
    padded = pad_charts(atlas, known)
    assert padded[0, 1].tolist() == [10, 20, 30]
    assert padded[4, 3].tolist() == [1, 2, 3]
    assert padded[known].tolist() == atlas[known].tolist()


def test_padding_of_nothing_known_changes_nothing() -> None:
    atlas = np.full((3, 3, 3), 9, dtype=np.uint8)
    assert (pad_charts(atlas, np.zeros((3, 3), dtype=bool)) == 9).all()
