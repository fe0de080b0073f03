"""The smallest end-to-end uses of the rasterizer: if one of these fails, look here first."""

from __future__ import annotations

import pytest
import torch

from ahoy_core.splat import Gaussians, rasterization


def one_gaussian(opacity: float = 0.8) -> Gaussians:
    return Gaussians(
        means=torch.tensor([[0.0, 0.0, 2.0]]),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        scales=torch.full((1, 3), 0.1),
        opacities=torch.tensor([opacity]),
        colors=torch.tensor([[1.0, 0.5, 0.25]]),
    )


def camera() -> tuple[torch.Tensor, torch.Tensor, int, int]:
    K = torch.tensor([[[100.0, 0.0, 16.5], [0.0, 100.0, 12.5], [0.0, 0.0, 1.0]]])
    return torch.eye(4)[None], K, 33, 25


def test_centre_pixel_shows_opacity_times_colour() -> None:
    g = one_gaussian()
    colors, alphas, _ = rasterization(g.means, g.quats, g.scales, g.opacities, g.colors, *camera())
    assert alphas[0, 12, 16, 0] == pytest.approx(0.8, abs=1e-6)
    torch.testing.assert_close(colors[0, 12, 16], 0.8 * g.colors[0], atol=1e-6, rtol=0)


def test_covariances_of_the_dataclass_render_as_its_quats_and_scales() -> None:
    g = one_gaussian()
    plain = rasterization(g.means, g.quats, g.scales, g.opacities, g.colors, *camera())[0]
    full = rasterization(g.means, None, None, g.opacities, g.colors, *camera(), covars=g.covariances())[0]
    torch.testing.assert_close(full, plain, atol=1e-6, rtol=0)


def test_gradient_descent_finds_an_opacity() -> None:
    g, raw = one_gaussian(), torch.zeros(1, requires_grad=True)
    target = rasterization(g.means, g.quats, g.scales, g.opacities, g.colors, *camera())[0]
    optimizer = torch.optim.Adam([raw], lr=0.3)
    for _ in range(60):
        optimizer.zero_grad()
        image = rasterization(g.means, g.quats, g.scales, raw.sigmoid(), g.colors, *camera())[0]
        (image - target).square().sum().backward()
        optimizer.step()
    assert raw.sigmoid().item() == pytest.approx(0.8, abs=0.02)


def test_intersections_beyond_the_memory_budget_are_refused_before_they_are_made() -> None:
    g = one_gaussian()
    with pytest.raises(MemoryError, match="memory_budget: expected at most 1 bytes"):
        rasterization(g.means, g.quats, g.scales, g.opacities, g.colors, *camera(), memory_budget=1)


def test_dataclass_refuses_rows_that_do_not_match() -> None:
    g = one_gaussian()
    with pytest.raises(ValueError, match=r"scales: expected shape \(1, 3\), got \(2, 3\)"):
        Gaussians(g.means, g.quats, torch.ones(2, 3), g.opacities, g.colors)
