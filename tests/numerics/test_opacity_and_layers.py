"""Hard cases of blending: opacity exactly 0 and 1, a thousand faint layers, thousands of identical Gaussians."""

from __future__ import annotations

import math

import pytest
import torch

from tests.numerics.hard import Render, frontal_scene, with_rows
from tests.splat.scenes import Scene, assert_matches_oracle, calm_scene, run


def stack(n: int, opacity: float, spread: float, scale: float = 0.4) -> Scene:
    """n Gaussians on the optical axis of a small image, between 3 and 3 + spread metres away."""
    scene = frontal_scene(n, width=20, height=17)
    scene["means"] = torch.stack([torch.zeros(n), torch.zeros(n), 3 + spread * torch.arange(n) / n], -1)
    scene["scales"] = scale * torch.tensor([1.0, 0.8, 1.25]).repeat(n, 1)
    scene["opacities"] = torch.full((n,), opacity)
    return scene


@pytest.mark.parametrize("opacity", [0.0, 1.0])
@pytest.mark.parametrize("rasterize_mode", ["classic", "antialiased"])
def test_opacity_at_its_ends_matches_the_oracle(render: Render, opacity: float, rasterize_mode: str) -> None:
    def edit(scene: Scene) -> Scene:
        # Wide enough that pixels lie where alpha exceeds the clamp.
        return with_rows(scene, [0, 5, 9, 20], opacities=opacity, scales=[0.7, 0.6, 0.5])

    assert_matches_oracle(render, calm_scene(1, n=30, rasterize_mode=rasterize_mode, edit=edit))


def test_a_wholly_opaque_scene_matches_the_oracle(render: Render) -> None:
    scene = calm_scene(2, n=25, edit=lambda scene: {**scene, "opacities": torch.ones(25)})
    assert_matches_oracle(render, scene)


def test_an_opaque_gaussian_reaches_as_far_as_the_cutoff_says(render: Render) -> None:
    scene = stack(1, 1.0, 0.0)
    scene["scales"] = torch.full((1, 3), 0.5)
    scene |= {"width": 128, "height": 96, "Ks": torch.tensor([[[60.0, 0, 64], [0, 60, 48], [0, 0, 1]]])}
    # A sphere's rotation has no gradient, so quats are left out.
    alphas = assert_matches_oracle(render, scene, wrt=("means", "scales", "opacities")).alphas[0, 48, :, 0]
    reach = math.sqrt(2 * math.log(255) * ((0.5 * 60 / 3) ** 2 + 0.3))
    offset = (torch.arange(128) + 0.5 - 64).abs()
    radius = torch.hypot(offset, torch.tensor(0.5))
    assert torch.equal(alphas > 0, radius < reach)
    assert reach > 3.3 * 10


def test_alpha_above_the_clamp_gives_the_same_image_and_no_gradient(render: Render) -> None:
    scene = stack(1, 1.0, 0.0, scale=500.0)
    rendered = assert_matches_oracle(render, scene)
    torch.testing.assert_close(rendered.alphas, torch.full_like(rendered.alphas, 0.999), atol=1e-6, rtol=0)
    assert not rendered.grads["opacities"].any()
    assert rendered.grads["colors"].any()


def test_a_thousand_faint_layers_match_the_oracle(render: Render) -> None:
    # 0.997^1000 leaves 5%; float32 rounding of a thousand products stays under 1000 * 6e-8.
    scene = stack(1000, 0.0045, 1.0, scale=30.0)
    rendered = assert_matches_oracle(render, scene)
    assert 0.9 < rendered.alphas.min() < rendered.alphas.max() < 0.999


@pytest.mark.parametrize("opacity", [0.01, 0.5, 1.0])
def test_five_thousand_identical_gaussians_match_the_oracle(render: Render, opacity: float) -> None:
    scene = stack(5000, opacity, 0.0, scale=30.0)
    # At opacity 1 the pixel keeps 1 - 0.999, of which float32 knows four digits less than of 1.
    assert_matches_oracle(render, scene, grad_rtol=1e-4 if opacity < 1 else 2e-4)


def test_transmittance_stop_leaves_out_what_crosses_it_and_all_behind(render: Render) -> None:
    scene = stack(40, 0.3, 1.0, scale=30.0)
    rendered = assert_matches_oracle(render, scene)
    blended = math.ceil(math.log(1e-4) / math.log(0.7)) - 1
    seen = rendered.grads["colors"].abs().sum(-1) > 0
    assert seen.tolist() == [True] * blended + [False] * (40 - blended)
    assert run(render, scene).alphas.max() < 1 - 1e-4
