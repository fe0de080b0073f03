"""One row of NaN or infinity: left out, reported, and nothing else changes by a bit."""

from __future__ import annotations

import math

import pytest
import torch

from tests.numerics.hard import Render, all_but, with_rows
from tests.splat.scenes import Scene, random_scene, run, same_gradients, select

N, ROW = 25, 11
PER_GAUSSIAN = ("means", "quats", "scales", "covars", "opacities", "colors")


def check_isolated(render: Render, scene: Scene) -> None:
    others = all_but(N, ROW)
    broken, clean = run(render, scene), run(render, select(scene, others))
    assert (broken.meta["n_invalid"], clean.meta["n_invalid"]) == (1, 0)
    assert torch.equal(broken.colors, clean.colors)
    assert torch.equal(broken.alphas, clean.alphas)
    for name, grad in broken.grads.items():
        assert torch.isfinite(grad).all(), f"{name}: the broken row must get a finite gradient, too"
        if name in PER_GAUSSIAN:
            assert not grad[ROW].any(), name
        assert same_gradients(render, grad[others] if name in PER_GAUSSIAN else grad, clean.grads[name]), name
    assert broken.alphas.max() > 0.5


@pytest.mark.parametrize("rasterize_mode", ["classic", "antialiased"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf], ids=str)
@pytest.mark.parametrize("name", ["means", "quats", "scales", "opacities", "colors"])
def test_a_broken_row_is_isolated(render: Render, name: str, value: float, rasterize_mode: str) -> None:
    if name == "scales" and value < 0:
        pytest.skip("a negative scale is refused outright")
    scene = random_scene(1, n=N, rasterize_mode=rasterize_mode)
    check_isolated(render, with_rows(scene, [ROW], **{name: value}))


@pytest.mark.parametrize("axis", range(3))
def test_one_broken_coordinate_is_enough(render: Render, axis: int) -> None:
    scene = random_scene(2, n=N, count=2)
    scene["means"][ROW, axis] = math.nan
    check_isolated(render, scene)


@pytest.mark.parametrize("value", [math.nan, math.inf], ids=str)
def test_a_broken_covariance_is_isolated(render: Render, value: float) -> None:
    scene = random_scene(3, n=N, covars=True)
    scene["covars"][ROW, 0, 1] = scene["covars"][ROW, 1, 0] = value
    check_isolated(render, scene)


def test_a_broken_coefficient_is_isolated(render: Render) -> None:
    scene = random_scene(4, n=N, sh_degree=3)
    scene["colors"][ROW, 7, 1] = math.nan
    check_isolated(render, scene)


@pytest.mark.parametrize("render_mode", ["D", "RGB+ED"])
def test_a_broken_row_is_isolated_in_depth_images(render: Render, render_mode: str) -> None:
    check_isolated(render, with_rows(random_scene(5, n=N, render_mode=render_mode), [ROW], means=math.inf))


def test_a_scene_of_broken_rows_only_is_background(render: Render) -> None:
    scene = random_scene(6, n=3)
    scene["means"] = torch.full((3, 3), math.nan)
    rendered = run(render, scene)
    assert rendered.meta["n_invalid"] == 3
    assert torch.equal(rendered.colors, scene["backgrounds"][:, None, None].expand_as(rendered.colors))
    assert not rendered.grads["viewmats"].any()
