"""Hard cases of size: nothing to draw, one pixel, sizes that tiles don't divide, full-screen splats, memory."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ahoy_core.splat import rasterization
from ahoy_core.splat._binning import to_offsets
from ahoy_core.splat._plan import Tiling, intersection_bytes
from tests.numerics.hard import Render, frontal_scene
from tests.splat.scenes import Scene, assert_matches_oracle, calm_scene, random_scene, run, select


@pytest.mark.parametrize(
    "options", [{}, {"sh_degree": 2}, {"covars": True}, {"count": 2}, {"render_mode": "RGB+ED"}], ids=str
)
def test_empty_input_is_background_with_gradients_of_the_right_shape(render: Render, options: dict) -> None:
    scene = select(random_scene(0, **options), torch.arange(0))
    rendered = run(render, scene)
    expected = scene["backgrounds"][:, None, None].expand(-1, 33, 40, -1)
    assert torch.equal(rendered.colors[..., :3], expected)
    assert not rendered.alphas.any()
    for name, grad in rendered.grads.items():
        assert grad.shape == scene[name].shape
        assert torch.isfinite(grad).all(), name


def test_nothing_in_view_is_background_with_zero_gradients(render: Render) -> None:
    scene = random_scene(0, n=20)
    scene["means"] = scene["means"] + 1e4
    rendered = run(render, scene)
    assert torch.equal(rendered.colors, scene["backgrounds"][:, None, None].expand_as(rendered.colors))
    assert not any(
        rendered.grads[name].any() for name in ("means", "quats", "scales", "opacities", "colors", "viewmats")
    )


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (40, 1), (16, 16), (17, 15), (31, 33), (7, 50)], ids=str)
def test_any_image_size_matches_the_oracle(render: Render, size: tuple[int, int]) -> None:
    assert_matches_oracle(render, calm_scene(1, n=40, width=size[0], height=size[1]))


@pytest.mark.parametrize("size", [(33, 40), (64, 64), (5, 3)], ids=str)
def test_tiles_of_8_16_and_32_give_the_same_bits(size: tuple[int, int]) -> None:
    scene = random_scene(2, n=150, width=size[0], height=size[1], rasterize_mode="antialiased")
    small, medium, large = (run(rasterization, {**scene, "tile_size": t}) for t in (8, 16, 32))
    for other in (small, large):
        assert torch.equal(other.colors, medium.colors)
        assert torch.equal(other.alphas, medium.alphas)
        for name, grad in other.grads.items():
            torch.testing.assert_close(
                grad, medium.grads[name], rtol=1e-4, atol=1e-5 * float(medium.grads[name].abs().max())
            )


def test_thousands_of_screen_filling_gaussians_match_the_oracle(render: Render) -> None:
    scene = frontal_scene(3000, width=40, height=33)
    generator = torch.Generator().manual_seed(0)
    scene["scales"] = 5 + torch.rand(3000, 3, generator=generator)
    scene["means"][:, 2] = 3 + torch.randperm(3000, generator=generator) / 3000
    scene["opacities"] = 0.006 + 0.001 * torch.rand(3000, generator=generator)
    assert_matches_oracle(render, scene)


def screen_filling(n: int, width: int, height: int) -> Scene:
    """n Gaussians that each touch every tile."""
    scene = frontal_scene(n, width=width, height=height)
    return {**scene, "scales": torch.full((n, 3), 1e4)}


def test_intersections_beyond_the_memory_budget_are_refused_before_they_are_held() -> None:
    scene = screen_filling(500, 1024, 1024)
    total = 500 * 64 * 64
    with pytest.raises(MemoryError, match=rf"memory_budget: expected at most 1000000 bytes .* got {total} intersect"):
        rasterization(**scene, memory_budget=1_000_000)


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_the_memory_budget_is_exact_and_does_not_change_the_image(threads: int) -> None:
    # The near half is tiny and the far half fills the screen, so that the threads' shares are very uneven.
    scene = screen_filling(40, 64, 64) | {"num_threads": threads}
    near = scene["means"][:, 2].argsort()[:20]
    scene["scales"][near] = 1e-3
    expected, _, meta = rasterization(**scene)
    needed = meta["n_isects"] * intersection_bytes(Tiling(64, 64, 16))
    assert torch.equal(rasterization(**scene, memory_budget=needed)[0], expected)
    with pytest.raises(MemoryError):
        rasterization(**scene, memory_budget=needed - 1)


def test_more_than_two_to_the_31_intersections_are_counted_rightly() -> None:
    counts = np.array([[2**31, 5], [7, 2**33]], np.int64)
    starts = to_offsets(counts)
    assert starts.tolist() == [0, 2**31 + 7, 2**31 + 12 + 2**33]
    assert counts.tolist() == [[0, 2**31 + 7], [2**31, 2**31 + 12]]
