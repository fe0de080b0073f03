"""Shapes, keys, modes and defaults of `rasterization`, on every backend."""

from __future__ import annotations

import pytest
import torch

from ahoy_core.splat import rasterization
from tests.splat.scenes import convert, random_scene, run

META_KEYS = ("radii", "means2d", "depths", "conics", "opacities", "tiles_per_gauss", "width", "height", "tile_size")


@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize("channels", [1, 3, 4, 17])
def test_image_has_a_row_per_camera_and_a_channel_per_feature(backend: str, count: int, channels: int) -> None:
    scene = convert(random_scene(0, count=count, channels=channels), device=backend)
    colors, alphas, meta = rasterization(**scene)
    assert colors.shape == (count, 33, 40, channels)
    assert alphas.shape == (count, 33, 40, 1)
    assert colors.dtype == alphas.dtype == torch.float32
    assert colors.device.type == backend
    assert isinstance(meta, dict)


@pytest.mark.parametrize(("mode", "channels"), [("RGB", 3), ("D", 1), ("ED", 1), ("RGB+D", 4), ("RGB+ED", 4)])
def test_render_mode_decides_the_channels(backend: str, mode: str, channels: int) -> None:
    scene = convert(random_scene(0, render_mode=mode), device=backend)
    colors, _, _ = rasterization(**scene)
    assert colors.shape == (1, 33, 40, channels)


def test_meta_speaks_gsplat(backend: str) -> None:
    scene = convert(random_scene(0, n=50, count=2), device=backend)
    _, _, meta = rasterization(**scene)
    for key in META_KEYS:
        assert key in meta, key
    assert meta["radii"].shape == (2, 50, 2)
    assert not meta["radii"].dtype.is_floating_point
    assert meta["means2d"].shape == (2, 50, 2)
    assert meta["depths"].shape == meta["opacities"].shape == meta["tiles_per_gauss"].shape == (2, 50)
    assert meta["conics"].shape == (2, 50, 3)
    assert (meta["width"], meta["height"], meta["tile_size"]) == (40, 33, 16)


def test_colors_may_differ_by_camera(backend: str) -> None:
    scene = convert(random_scene(0, count=2), device=backend)
    scene["colors"] = torch.stack([scene["colors"], scene["colors"].flip(-1)])
    both, _, _ = rasterization(**scene)
    for i in range(2):
        own, _, _ = rasterization(**{**scene, "colors": scene["colors"][i]})
        assert torch.equal(both[i], own[i])


def test_cameras_are_rendered_independently(backend: str) -> None:
    scene = convert(random_scene(0, count=3), device=backend)
    together = rasterization(**scene)[0]
    for i in range(3):
        alone = rasterization(**{**scene, **{k: scene[k][i : i + 1] for k in ("viewmats", "Ks", "backgrounds")}})[0]
        assert torch.equal(together[i], alone[0])


def test_no_background_is_black(backend: str) -> None:
    scene = convert(random_scene(0), device=backend)
    black = rasterization(**{**scene, "backgrounds": torch.zeros_like(scene["backgrounds"])})[0]
    none = rasterization(**{**scene, "backgrounds": None})[0]
    assert torch.equal(black, none)


def test_background_shows_where_nothing_is(backend: str) -> None:
    scene = convert(random_scene(0, n=3), device=backend)
    scene["opacities"] = scene["opacities"] * 0
    colors, alphas, _ = rasterization(**scene)
    assert torch.equal(colors, scene["backgrounds"][:, None, None].expand_as(colors))
    assert not alphas.any()


def test_quats_and_scales_equal_their_covariance(backend: str) -> None:
    pair, covars = (convert(random_scene(7, covars=c), device=backend) for c in (False, True))
    torch.testing.assert_close(rasterization(**pair)[0], rasterization(**covars)[0], atol=1e-5, rtol=0)


def test_sh_degree_zero_is_a_constant_colour(backend: str) -> None:
    scene = convert(random_scene(0, sh_degree=0), device=backend)
    plain = {**scene, "sh_degree": None, "colors": (scene["colors"][:, 0] * 0.28209479177387814 + 0.5).clamp(min=0)}
    torch.testing.assert_close(rasterization(**scene)[0], rasterization(**plain)[0], atol=1e-6, rtol=0)


def test_higher_bands_than_asked_for_are_ignored(backend: str) -> None:
    scene = convert(random_scene(0, sh_degree=1), device=backend)
    cut = {**scene, "colors": scene["colors"][:, :4].contiguous()}
    assert torch.equal(rasterization(**scene)[0], rasterization(**cut)[0])
    assert not run(rasterization, scene, ["colors"]).grads["colors"][:, 4:].any()


def test_radius_clip_drops_what_is_small(backend: str) -> None:
    scene = convert(random_scene(0), device=backend)
    _, _, meta = rasterization(**scene)
    largest = float(meta["radii"].max())
    colors, _, clipped = rasterization(**scene, radius_clip=largest)
    assert not clipped["radii"].any()
    assert torch.equal(colors, scene["backgrounds"][:, None, None].expand_as(colors))


def test_radius_bounds_every_visible_contribution(backend: str) -> None:
    scene = convert(random_scene(0, n=1, opacities=torch.tensor([1.0]), backgrounds=False), device=backend)
    _, alphas, meta = rasterization(**scene)
    ys, xs = torch.nonzero(alphas[0, ..., 0], as_tuple=True)
    reach = torch.stack([xs, ys], -1) + 0.5 - meta["means2d"][0, 0]
    assert len(reach) > 0
    assert (reach.abs() <= meta["radii"][0, 0]).all()


def test_inputs_are_not_changed(backend: str) -> None:
    scene = convert(random_scene(0), device=backend)
    before = {k: v.clone() for k, v in scene.items() if torch.is_tensor(v)}
    run(rasterization, scene)
    for name, value in before.items():
        assert torch.equal(scene[name], value), name


def test_gradients_come_back_in_the_dtype_and_shape_of_their_inputs() -> None:
    for dtype in (torch.float32, torch.float64):
        scene = random_scene(0, count=2, dtype=dtype)
        rendered = run(rasterization, scene)
        assert rendered.colors.dtype == dtype
        for name, grad in rendered.grads.items():
            assert grad.shape == scene[name].shape
            assert grad.dtype == dtype
            assert grad.any(), name


def test_no_graph_is_kept_where_no_gradient_is_asked_for(backend: str) -> None:
    scene = convert(random_scene(0), device=backend)
    assert not rasterization(**scene)[0].requires_grad
    scene["means"].requires_grad_()
    with torch.no_grad():
        assert not rasterization(**scene)[0].requires_grad
