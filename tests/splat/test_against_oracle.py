"""Image within 1e-5 and gradients within 1e-4 (relative L2) of the float64 oracle, in every mode."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from ahoy_core.splat import rasterization
from tests.splat.scenes import (
    assert_matches_oracle,
    calm_scene,
    convert,
    count_outliers,
    oracle,
    pixel_errors,
    random_scene,
    reference,
    relative_l2,
    run,
)

MODES: dict[str, dict[str, Any]] = {
    "plain": {},
    "no background": {"backgrounds": False},
    "three cameras": {"count": 3},
    "one channel": {"channels": 1},
    "coverage as fourth channel": {"channels": 4},
    "seventeen channels": {"channels": 17},
    "ortho": {"camera_model": "ortho"},
    "antialiased": {"rasterize_mode": "antialiased"},
    "antialiased ortho": {"rasterize_mode": "antialiased", "camera_model": "ortho"},
    "covars": {"covars": True},
    "covars antialiased": {"covars": True, "rasterize_mode": "antialiased"},
    "SH 0": {"sh_degree": 0},
    "SH 1": {"sh_degree": 1},
    "SH 2": {"sh_degree": 2},
    "SH 3": {"sh_degree": 3, "count": 2},
    "D": {"render_mode": "D"},
    "ED": {"render_mode": "ED"},
    "RGB+D": {"render_mode": "RGB+D"},
    "RGB+ED": {"render_mode": "RGB+ED", "count": 2},
    "RGB+ED ortho SH antialiased": {
        "render_mode": "RGB+ED", "camera_model": "ortho", "sh_degree": 3, "rasterize_mode": "antialiased",
    },
    "eps2d 0.1": {"eps2d": 0.1},
    "planes": {"near_plane": 2.6, "far_plane": 3.4},
    "other thresholds": {"alpha_cutoff": 1e-3, "transmittance_stop": 1e-2},
    "forty channels": {"channels": 40},
    "channels two at a time": {"channels": 5, "channel_chunk": 2, "render_mode": "RGB+D"},
}  # fmt: skip


@pytest.mark.parametrize("mode", MODES)
def test_image_and_every_gradient_match_the_oracle(backend: str, mode: str) -> None:
    if backend == "cuda" and mode == "other thresholds":
        with pytest.raises(NotImplementedError, match=r"alpha_cutoff: expected 0\.0039.* on a GPU, got 0\.001"):
            rasterization(**convert(random_scene(1, **MODES[mode]), device=backend))
        return
    assert_matches_oracle(rasterization, calm_scene(1, **MODES[mode]), device=backend)


@pytest.mark.parametrize("mode", ["plain", "antialiased", "ortho", "SH 3", "RGB+ED", "covars"])
def test_float64_kernels_agree_to_1e_9(mode: str) -> None:
    scene = calm_scene(2, dtype=torch.float64, **MODES[mode])
    assert_matches_oracle(rasterization, scene, image_atol=1e-9, grad_rtol=1e-8)


@pytest.mark.parametrize("seed", range(3))
def test_where_thresholds_flip_few_pixels_do(backend: str, seed: int) -> None:
    scene = random_scene(seed, n=200, width=64, height=64)
    scene["colors"] = scene["colors"].clamp(0, 1)
    colors, alphas, _ = rasterization(**convert(scene, device=backend))
    expected, expected_alphas = reference(**scene)
    # About 64 x 64 x 200 decisions, of which the share within a relative 1e-6 of the cutoff is under 1e-6: a handful.
    assert count_outliers(colors, expected) <= 8
    assert count_outliers(alphas, expected_alphas) <= 8
    assert pixel_errors(colors, expected).max() < 1.1 / 255


def test_gradient_of_projected_means_is_retained(backend: str) -> None:
    scene = calm_scene(3)
    scene["means"].requires_grad_()
    device_scene = convert(scene, device=backend)
    colors, _, meta = rasterization(**device_scene)
    meta["means2d"].retain_grad()
    weights = torch.rand(colors.shape, generator=torch.Generator().manual_seed(0))
    (colors * weights.to(colors)).sum().backward()
    half = oracle.quat_to_matrix(scene["quats"].double()) * scene["scales"].double()[:, None]
    camera: Any = scene["viewmats"][0].double(), scene["Ks"][0].double(), 40, 33, 0.01, 1e10, 0.3, "pinhole", True
    splats = oracle.project(scene["means"].detach().double(), half @ half.transpose(1, 2), *camera)
    means2d = splats.means2d.clone().requires_grad_()
    image = oracle.camera_image(
        splats._replace(means2d=means2d), scene["opacities"].double()[splats.ids], scene["colors"].double()[splats.ids],
        40, 33, alpha_cutoff=1 / 255, alpha_max=0.999, transmittance_stop=1e-4,
    )  # fmt: skip
    image = image[..., :3] + (1 - image[..., 3:]) * scene["backgrounds"].double()
    (image * weights[0].double()).sum().backward()
    assert means2d.grad is not None
    expected = torch.zeros(len(scene["means"]), 2, dtype=torch.float64).index_copy(0, splats.ids, means2d.grad)
    assert relative_l2(meta["means2d"].grad[0].double().cpu(), expected) < 1e-4


def test_a_second_backward_through_the_same_graph_gives_the_same_gradients(backend: str) -> None:
    scene = convert(calm_scene(1), device=backend)
    means = scene["means"].requires_grad_()
    colors, _, _ = rasterization(**scene)
    first, second = (torch.autograd.grad(colors.square().sum(), means, retain_graph=True)[0] for _ in range(2))
    assert torch.equal(first, second) if backend == "cpu" else torch.allclose(first, second, rtol=1e-4)


@pytest.mark.parametrize("name", ["means", "quats", "scales", "opacities", "colors", "viewmats", "backgrounds"])
def test_a_gradient_does_not_depend_on_which_others_are_asked_for(backend: str, name: str) -> None:
    scene = convert(calm_scene(1), device=backend)
    alone, together = run(rasterization, scene, [name]).grads[name], run(rasterization, scene).grads[name]
    torch.testing.assert_close(alone, together, rtol=1e-5, atol=1e-6 * float(together.abs().max()))


def test_alpha_alone_carries_gradients(backend: str) -> None:
    scene = calm_scene(1)

    def alpha_only(render: Any) -> torch.Tensor:
        means = scene["means"].clone().requires_grad_()
        device = backend if render is rasterization else "cpu"
        out = render(**convert({**scene, "means": means}, device=device))
        (out[1] * torch.linspace(0, 1, 33)[:, None, None].to(out[1])).sum().backward()
        assert means.grad is not None
        return means.grad.double()

    assert relative_l2(alpha_only(rasterization), alpha_only(reference)) < 1e-4
