"""The oracle itself: closed forms on paper, and autograd against finite differences."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch

from ahoy_core.splat import oracle
from tests.splat.scenes import random_scene


def one_gaussian(**options: Any) -> dict[str, Any]:
    """An isotropic Gaussian of 0.1 m, 2 m before a camera of 20 px focal length, at the centre of pixel (4, 3)."""
    return {
        "means": torch.tensor([[0.0, 0.0, 2.0]]), "quats": torch.tensor([[1.0, 0, 0, 0]]),
        "scales": torch.full((1, 3), 0.1),
        "opacities": torch.tensor([0.8]), "colors": torch.tensor([[0.5, 1.0]]), "viewmats": torch.eye(4)[None],
        "Ks": torch.tensor([[[20.0, 0, 4.5], [0, 20, 3.5], [0, 0, 1]]]), "width": 9, "height": 7, **options,
    }  # fmt: skip


@pytest.mark.parametrize(("camera_model", "sigma"), [("pinhole", 0.1 * 20 / 2), ("ortho", 0.1 * 20)])
def test_one_gaussian_follows_the_closed_form(camera_model: str, sigma: float) -> None:
    colors, alphas = oracle.render(**one_gaussian(camera_model=camera_model))
    variance = sigma**2 + 0.3
    expected = 0.8 * math.exp(-0.5 * (2**2 + 1**2) / variance)
    assert alphas[0, 3, 4, 0].item() == pytest.approx(0.8, abs=1e-7)
    assert alphas[0, 4, 6, 0].item() == pytest.approx(expected, rel=1e-6)
    torch.testing.assert_close(colors[0, 4, 6], expected * torch.tensor([0.5, 1.0]).double(), rtol=1e-6, atol=0)


def test_antialiasing_scales_opacity_by_the_root_of_the_determinants() -> None:
    sharp, blurred = (oracle.render(**one_gaussian(rasterize_mode=m))[1] for m in ("antialiased", "classic"))
    assert (sharp / blurred).max().item() == pytest.approx(1 / 1.3, rel=1e-6)


def test_near_gaussian_hides_far_one_whatever_their_order() -> None:
    scene = one_gaussian(
        means=torch.tensor([[0.0, 0, 4], [0, 0, 2]]), quats=torch.ones(2, 4), scales=torch.full((2, 3), 0.1),
        opacities=torch.tensor([0.5, 0.8]), colors=torch.tensor([[1.0], [0.0]]), backgrounds=torch.tensor([[10.0]]),
    )  # fmt: skip
    colors, alphas = oracle.render(**scene)
    assert alphas[0, 3, 4, 0].item() == pytest.approx(1 - 0.2 * 0.5, rel=1e-6)
    assert colors[0, 3, 4, 0].item() == pytest.approx(0.2 * 0.5 + 10 * 0.2 * 0.5, rel=1e-6)


def test_depth_modes_are_weighted_and_expected_depth() -> None:
    depth, alphas = oracle.render(**one_gaussian(render_mode="D", backgrounds=torch.ones(1, 2)))
    expected, _ = oracle.render(**one_gaussian(render_mode="RGB+ED"))
    torch.testing.assert_close(depth, 2 * alphas)
    assert expected.shape[-1] == 3
    torch.testing.assert_close(expected[..., 2:], torch.full_like(depth, 2.0))


def test_shortcuts_are_off_until_asked_for() -> None:
    scene = random_scene(3)
    exact, shortcut = oracle.render(**scene)[0], oracle.render(**scene, **oracle.GSPLAT)[0]
    assert 1e-5 < (exact - shortcut).abs().max() < 0.2
    assert oracle.render(**one_gaussian())[1].min() > 0
    assert oracle.render(**one_gaussian(), alpha_cutoff=1 / 255)[1].min() == 0
    assert oracle.render(**one_gaussian(), alpha_max=0.3)[1].max().item() == pytest.approx(0.3)
    assert oracle.render(**one_gaussian(), transmittance_stop=0.5)[1][0, 3, 4, 0] == 0


@pytest.mark.parametrize("camera_model", ["pinhole", "ortho"])
@pytest.mark.parametrize("rasterize_mode", ["classic", "antialiased"])
@pytest.mark.parametrize(("render_mode", "sh_degree"), [("RGB+ED", 3), ("D", None)])
def test_autograd_agrees_with_finite_differences(
    camera_model: str, rasterize_mode: str, render_mode: str, sh_degree: int | None
) -> None:
    scene = random_scene(
        1, n=3, width=5, height=4, camera_model=camera_model, rasterize_mode=rasterize_mode, render_mode=render_mode,
        sh_degree=sh_degree, dtype=torch.float64,
    )  # fmt: skip
    names = ["means", "quats", "scales", "opacities", "colors", "viewmats", "backgrounds"]

    def function(*leaves: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return oracle.render(**{**scene, **dict(zip(names, leaves, strict=True))}, frustum_clamp=True)

    assert torch.autograd.gradcheck(function, [scene[k].requires_grad_() for k in names])


def test_covariance_gradient_agrees_with_finite_differences() -> None:
    scene = random_scene(2, n=3, width=5, height=4, covars=True, dtype=torch.float64)

    def function(covars: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return oracle.render(**{**scene, "covars": covars}, **oracle.GSPLAT)

    assert torch.autograd.gradcheck(function, [scene["covars"].requires_grad_()])
