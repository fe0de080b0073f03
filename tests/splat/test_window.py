"""A window is that part of the whole image, values and gradients, and footprints hold every pixel that changes."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ahoy_core.splat import footprints, hull, meeting, rasterization
from tests.splat.scenes import Scene, random_scene

properties = settings(max_examples=15, deadline=None, derandomize=True)
windows = st.tuples(st.integers(0, 20), st.integers(0, 16), st.integers(1, 20), st.integers(1, 17))
scenes = st.builds(
    random_scene,
    seed=st.integers(0, 10**6),
    n=st.integers(1, 80),
    count=st.integers(1, 2),
    camera_model=st.sampled_from(["pinhole", "ortho"]),
    dtype=st.just(torch.float64),
    tile_size=st.sampled_from([8, 16]),
)


@properties
@given(scenes, windows)
def test_a_window_is_that_part_of_the_image_with_its_gradients(scene: Scene, window: tuple[int, int, int, int]):
    left, top, width, height = window
    means = scene["means"].requires_grad_()
    whole, alphas, _ = rasterization(**scene)
    part, part_alphas, meta = rasterization(**scene, window=window)
    rows, columns = slice(top, top + height), slice(left, left + width)
    # The window's coordinates round otherwise than the image's, by the last place of float64.
    assert torch.allclose(part, whole[:, rows, columns], atol=1e-11)
    assert torch.allclose(part_alphas, alphas[:, rows, columns], atol=1e-11)
    assert (meta["width"], meta["height"]) == (width, height)
    weights = torch.rand(part.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    (of_part,) = torch.autograd.grad((part * weights).sum(), means)
    (of_whole,) = torch.autograd.grad((whole[:, rows, columns] * weights).sum(), means)
    assert torch.allclose(of_part, of_whole, rtol=1e-9, atol=1e-9)


@properties
@given(st.integers(0, 10**6), st.integers(0, 39))
def test_a_gaussian_changes_no_pixel_outside_its_footprint(seed: int, row: int):
    scene = random_scene(seed, 40, covars=True, backgrounds=False)
    one = {**scene, **{name: scene[name][row : row + 1] for name in ("means", "covars", "opacities", "colors")}}
    _, alphas, _ = rasterization(**one)
    box = footprints(one["means"], one["covars"], one["opacities"], one["viewmats"], one["Ks"], 40, 33)[0]
    changed = torch.nonzero(alphas[0, :, :, 0] > 0)
    if hull(box) is None:
        assert not len(changed)
        return
    left, top, right, bottom = box[0].tolist()
    assert bool(((changed >= torch.tensor([top, left])) & (changed < torch.tensor([bottom, right]))).all())
    # A circumscribed box of an ellipse whose radius was rounded up: two pixels of slack at most.
    if len(changed) and left > 0 and right < 40:
        assert right - left <= changed[:, 1].max() - changed[:, 1].min() + 1 + 6


def test_boxes_meet_a_window_where_they_share_a_pixel():
    box = torch.tensor([[0.0, 0, 4, 4], [4, 0, 8, 4], [0, 4, 4, 8], [3, 3, 5, 5], [2, 2, 2, 2]])
    assert meeting(box, (0, 0, 4, 4)).tolist() == [True, False, False, True, False]
    assert hull(box[:2]) == (0, 0, 8, 4) and hull(box[4:]) is None


@pytest.mark.parametrize("window", [(-1, 0, 4, 4), (0, 0, 0, 4), (30, 0, 20, 4), (0, 30, 4, 20)])
def test_a_window_outside_the_image_is_refused(window: tuple[int, int, int, int]):
    with pytest.raises(ValueError, match="window"):
        rasterization(**random_scene(0), window=window)
