"""Hard cases of position: the near plane, far off the frustum, close and equal depths, a world far from its origin."""

from __future__ import annotations

import pytest
import torch

from ahoy_core.splat import oracle, rasterization
from tests.numerics.hard import Render, camera_space, frontal_scene, with_rows
from tests.splat.scenes import (
    Scene,
    assert_matches_oracle,
    calm_scene,
    convert,
    random_scene,
    reference,
    run,
    same_gradients,
    select,
)


@pytest.mark.parametrize("depth", [-5.0, -0.25, -1e-30, 0.0, 1e-30, 0.2499, 0.25], ids=str)
def test_gaussians_behind_and_at_the_near_plane_are_absent(render: Render, depth: float) -> None:
    scene = {**frontal_scene(20), "near_plane": 0.25}
    scene = with_rows(scene, [0, 7], means=[[0.0, 0.0, depth], [1e-3, 0.01, depth]], scales=0.3, opacities=0.9)
    rows = (torch.arange(20) != 0) & (torch.arange(20) != 7)
    with_them, without = run(render, scene), run(render, select(scene, rows))
    assert torch.equal(with_them.colors, without.colors)
    for name, grad in with_them.grads.items():
        expected = without.grads[name]
        assert torch.isfinite(grad).all(), name
        assert same_gradients(render, grad[rows] if len(grad) == 20 else grad, expected), name
        assert len(grad) != 20 or not grad[~rows].any(), name


def test_gaussians_that_straddle_the_near_plane_match_the_oracle(render: Render) -> None:
    def edit(scene: Scene) -> Scene:
        points = torch.tensor([[0.05, 0.02, 0.25], [-0.1, 0.1, 0.22]])
        return with_rows(scene, [0, 7], means=camera_space(scene, points), scales=0.15, opacities=0.5)

    assert_matches_oracle(render, calm_scene(1, n=30, near_plane=0.2, edit=edit))


@pytest.mark.parametrize("offset", [20.0, 1e3, 1e6, 1e10, 1e18])
def test_gaussians_far_off_the_frustum_match_the_oracle(render: Render, offset: float) -> None:
    def edit(scene: Scene) -> Scene:
        points = [[offset, 0.3, 3.0], [0.1, -offset, 2.0], [offset, offset, 0.011], [offset, 0, offset / 2]]
        means = camera_space(scene, torch.tensor(points))
        # As wide as they are deep: with an unclamped Jacobian their images would reach the frustum from any distance.
        return with_rows(scene, [0, 1, 2, 3], means=means, scales=3.0, opacities=0.9)

    assert_matches_oracle(render, calm_scene(2, n=30, edit=edit))


def test_a_wide_gaussian_beside_the_frustum_shows_with_the_clamped_jacobian(render: Render) -> None:
    def edit(scene: Scene) -> Scene:
        points = torch.tensor([[4.0, 0.3, 3.0], [0.1, -3.0, 2.0]])
        return with_rows(scene, [0, 1], means=camera_space(scene, points), scales=1.5, opacities=0.9)

    scene = calm_scene(3, n=30, edit=edit)
    rendered = assert_matches_oracle(render, scene)
    shortcuts = {**oracle.GSPLAT, "frustum_clamp": False}
    assert (rendered.alphas - oracle.render(**scene, **shortcuts)[1]).abs().max() > 0.01


@pytest.mark.parametrize("depth", [3.0, 100.0, 5000.0])
def test_layers_one_part_in_a_million_apart_are_sorted_rightly(render: Render, depth: float) -> None:
    scene = frontal_scene(12, backgrounds=None)
    ladder = torch.full((), depth) * (1 + 1e-6 * torch.arange(12))
    order = torch.randperm(12, generator=torch.Generator().manual_seed(1))
    scene["means"] = torch.stack([torch.zeros(12), torch.zeros(12), ladder[order]], -1)
    scene["scales"] = depth * torch.tensor([0.3, 0.25, 0.35]).repeat(12, 1)
    scene["opacities"] = torch.full((12,), 0.6)
    assert len(scene["means"][:, 2].unique()) == 12
    assert_matches_oracle(render, scene)


@pytest.mark.parametrize("tile_size", [8, 16, 32])
@pytest.mark.parametrize("seed", range(3))
def test_equal_depths_blend_in_the_order_of_the_input(render: Render, seed: int, tile_size: int) -> None:
    def edit(scene: Scene) -> Scene:
        scene["means"][:, 2] = torch.tensor([2.5, 3.0, 3.5])[torch.arange(40) % 3]
        scene["viewmats"] = torch.eye(4)[None]
        return scene

    scene = calm_scene(seed, n=40, edit=edit, ties=True)
    assert_matches_oracle(render, {**scene, "tile_size": tile_size})


def test_moving_other_gaussians_in_the_input_does_not_change_how_ties_blend(render: Render) -> None:
    scene = frontal_scene(60)
    scene["means"][:30, 2] = 3.0
    expected = render(**scene)[0]
    generator = torch.Generator().manual_seed(0)
    for _ in range(5):
        place = torch.rand(60, generator=generator)
        place[:30] = place[:30].sort().values
        assert torch.equal(render(**select(scene, place.argsort()))[0], expected)


def test_a_world_shifted_by_a_million_metres_in_float64_looks_the_same() -> None:
    scene = calm_scene(4, n=60)
    shift = torch.tensor([1e6, -1e6, 1e6], dtype=torch.float64)
    viewmats = scene["viewmats"].double()
    viewmats[:, :3, 3] -= viewmats[:, :3, :3] @ shift
    moved = {**scene, "means": scene["means"].double() + shift, "viewmats": viewmats}
    rendered = assert_matches_oracle(rasterization, moved)
    near_home = run(rasterization, scene)
    torch.testing.assert_close(rendered.colors.float(), near_home.colors, atol=2e-5, rtol=0)


@pytest.mark.parametrize("sh_degree", [None, 3])
def test_a_world_shifted_by_a_million_metres_in_float32_matches_the_oracle_fed_with_the_same_rounding(
    sh_degree: int | None,
) -> None:
    def edit(scene: Scene) -> Scene:
        # A world of hundreds of metres: float32 still has steps of 1/16 m at a million.
        shift = torch.tensor([1e6, -1e6, 1e6], dtype=torch.float64)
        viewmats = scene["viewmats"].double()
        viewmats[:, :3, 3] = 200 * viewmats[:, :3, 3] - viewmats[:, :3, :3] @ shift
        means = 200 * scene["means"].double() + shift
        return convert({**scene, "means": means, "scales": 200 * scene["scales"], "viewmats": viewmats}, torch.float32)

    assert_matches_oracle(rasterization, calm_scene(5, n=60, edit=edit, sh_degree=sh_degree))


def test_a_camera_pose_far_from_the_origin_gets_its_gradient() -> None:
    scene = random_scene(6, n=60)
    scene["viewmats"] = scene["viewmats"].double()
    shift = torch.tensor([3e5, 2e5, -1e5], dtype=torch.float64)
    scene["viewmats"][:, :3, 3] -= scene["viewmats"][:, :3, :3] @ shift
    scene["means"] = scene["means"].double() + shift
    grads = run(rasterization, scene, ["viewmats"]).grads["viewmats"]
    expected = run(reference, scene, ["viewmats"]).grads["viewmats"]
    torch.testing.assert_close(grads[:, :3, 3].double(), expected[:, :3, 3], rtol=1e-3, atol=1e-3)
