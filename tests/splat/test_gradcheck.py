"""Finite differences through the real kernels, compiled for float64: the projection and the blend."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from ahoy_core.splat import rasterization
from tests.splat.scenes import calm_scene

PROJECTION = ["means", "quats", "scales", "viewmats"]
BLEND = ["opacities", "colors", "backgrounds"]


def check(scene: dict[str, Any], names: list[str]) -> None:
    """Finite differences of 1e-6 stay clear of the thresholds because the scene does (FLIP_MARGIN)."""

    def function(*leaves: Tensor) -> tuple[Tensor, Tensor]:
        colors, alphas, _ = rasterization(**{**scene, **dict(zip(names, leaves, strict=True))})
        return colors, alphas

    leaves = [scene[k].clone().requires_grad_() for k in names]
    assert torch.autograd.gradcheck(function, leaves, eps=1e-7, atol=1e-5, rtol=1e-4, nondet_tol=0.0)


@pytest.mark.parametrize("camera_model", ["pinhole", "ortho"])
@pytest.mark.parametrize("rasterize_mode", ["classic", "antialiased"])
def test_projection(camera_model: str, rasterize_mode: str) -> None:
    options: Any = {"camera_model": camera_model, "rasterize_mode": rasterize_mode}
    check(calm_scene(1, n=4, width=9, height=8, dtype=torch.float64, **options), PROJECTION)


def test_projection_of_covariances() -> None:
    scene = calm_scene(1, n=4, width=9, height=8, covars=True, dtype=torch.float64)
    upper = scene["covars"].triu()

    def function(triangle: Tensor) -> Tensor:
        symmetric = triangle.triu() + triangle.triu(1).transpose(1, 2)
        return rasterization(**{**scene, "covars": symmetric.contiguous()})[0]

    assert torch.autograd.gradcheck(function, [upper.requires_grad_()], eps=1e-7, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("channels", [1, 3, 5])
def test_blend(channels: int) -> None:
    check(calm_scene(2, n=8, width=9, height=8, channels=channels, dtype=torch.float64), BLEND)


@pytest.mark.parametrize("render_mode", ["D", "RGB+ED"])
def test_depth_modes(render_mode: str) -> None:
    check(calm_scene(3, n=4, width=7, height=6, render_mode=render_mode, dtype=torch.float64), ["means", "opacities"])


def test_spherical_harmonics() -> None:
    scene = calm_scene(4, n=3, width=7, height=6, sh_degree=3, dtype=torch.float64)
    scene["colors"] = 0.3 * scene["colors"]
    check(scene, ["means", "colors", "viewmats"])


def test_clamped_jacobian_outside_the_frustum() -> None:
    scene = calm_scene(5, n=6, width=9, height=8, dtype=torch.float64)
    scene["means"][:, 0] += torch.linspace(-2.5, 2.5, 6, dtype=torch.float64)
    scene["scales"] = scene["scales"] + 0.4
    check(scene, PROJECTION)
