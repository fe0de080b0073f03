"""The comparisons that the suite leans on: they count what they should, and they can fail."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.splat import scenes


def test_outliers_are_counted_by_pixel_and_not_by_channel() -> None:
    image = torch.zeros(1, 4, 4, 3)
    other = image.clone()
    other[0, 1, 2] = 0.5
    other[0, 3, 3, 0] = 2e-5
    other[0, 0, 0, 0] = 0.9e-5
    assert scenes.count_outliers(other, image) == 2
    assert scenes.count_outliers(image, image) == 0


def test_nan_counts_as_an_outlier() -> None:
    image = torch.zeros(1, 2, 2, 3)
    broken = image.clone()
    broken[0, 0, 0, 1] = torch.nan
    assert scenes.count_outliers(broken, image) == 1


def test_large_values_are_compared_relatively() -> None:
    image = torch.full((1, 1, 1, 1), 1000.0)
    assert scenes.count_outliers(image + 0.005, image) == 0
    assert scenes.count_outliers(image + 0.02, image) == 1


def test_relative_l2_tells_zero_from_wrong() -> None:
    zero, one = torch.zeros(3), torch.ones(3)
    assert scenes.relative_l2(zero, zero) == 0
    assert scenes.relative_l2(one, zero) == math.inf
    assert scenes.relative_l2(one * 1.01, one) == pytest.approx(0.01, rel=1e-4)


def test_flip_margin_sees_an_alpha_at_the_cutoff() -> None:
    scene = scenes.calm_scene(5, n=10)
    scene["opacities"] = scene["opacities"].double()
    assert scenes.flip_margin(scene) > scenes.FLIP_MARGIN
    covars = scenes.oracle.quat_to_matrix(scene["quats"].double()) * scene["scales"].double()[:, None]
    camera: Any = scene["viewmats"][0].double(), scene["Ks"][0].double(), 40, 33, 0.01, 1e10, 0.3, "pinhole", True
    splats = scenes.oracle.project(scene["means"].double(), covars @ covars.transpose(1, 2), *camera)
    pixel = splats.means2d[:1].floor() + 0.5
    share = scenes.oracle.pixel_alphas(splats, torch.ones(len(splats.ids)).double(), pixel)[0, 0]
    scene["opacities"][splats.ids[0]] = (1 + 1e-6) / 255 / share
    assert scenes.flip_margin(scene) < 2e-6


def test_flip_margin_sees_a_tie_in_depth() -> None:
    scene = scenes.calm_scene(5, n=10)
    scene["means"][1] = scene["means"][0]
    assert scenes.flip_margin(scene) == 0


@pytest.mark.parametrize("broken", ["colors", "alphas", "nan"])
def test_matching_fails_on_a_wrong_image(broken: str) -> None:
    def render(**scene: Any) -> tuple[Tensor, Tensor]:
        colors, alphas = scenes.reference(**scene)
        if broken == "nan":
            return colors * torch.where(torch.arange(colors.shape[2])[:, None] == 3, torch.nan, 1.0), alphas
        return (colors + 2e-5, alphas) if broken == "colors" else (colors, alphas + 2e-5)

    scenes.assert_matches_oracle(scenes.reference, scenes.random_scene(0, n=5))
    with pytest.raises(AssertionError):
        scenes.assert_matches_oracle(render, scenes.random_scene(0, n=5))


@pytest.mark.parametrize("name", ["means", "quats", "scales", "opacities", "colors", "viewmats", "backgrounds"])
def test_matching_fails_on_a_wrong_gradient(name: str) -> None:
    def render(**scene: Any) -> tuple[Tensor, Tensor]:
        value = scene[name]
        return scenes.reference(**{**scene, name: value.detach() + 1.001 * (value - value.detach())})

    with pytest.raises(AssertionError, match=f"gradient of {name}"):
        scenes.assert_matches_oracle(render, scenes.random_scene(0, n=5))


def test_flips_pass_by_number_and_not_by_size() -> None:
    def render(step: float, count: int) -> Any:
        def shifted(**scene: Any) -> tuple[Tensor, Tensor]:
            colors, alphas = scenes.reference(**scene)
            mask = (torch.arange(colors.shape[1] * colors.shape[2]) < count).reshape(1, colors.shape[1], -1, 1)
            return colors + step * mask, alphas

        return shifted

    scene = scenes.random_scene(0, n=5)
    scenes.assert_matches_oracle(render(1 / 255, 2), scene, outliers=2)
    for step, count in ((1 / 255, 3), (0.05, 1)):
        with pytest.raises(AssertionError):
            scenes.assert_matches_oracle(render(step, count), scene, outliers=2)
