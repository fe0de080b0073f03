"""What must hold for every scene, on scenes drawn by hypothesis (float64 where the arithmetic itself changes)."""

from __future__ import annotations

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from ahoy_core.splat import oracle, rasterization
from tests.splat.scenes import (
    Scene,
    cameras,
    convert,
    count_outliers,
    look_at_rotation,
    random_scene,
    reference,
    select,
)

properties = settings(max_examples=12, deadline=None, derandomize=True)
COLOR_ATOL = 1e-12
"""Float64 rounding of sums of a hundred terms of order one."""

scene_arguments = {
    "seed": st.integers(0, 10**6),
    "n": st.integers(1, 80),
    "width": st.integers(1, 40),
    "height": st.integers(1, 40),
    "count": st.integers(1, 2),
    "camera_model": st.sampled_from(["pinhole", "ortho"]),
    "rasterize_mode": st.sampled_from(["classic", "antialiased"]),
}
scenes32 = st.builds(random_scene, **scene_arguments)
scenes64 = st.builds(random_scene, **scene_arguments, dtype=st.just(torch.float64))


def image(scene: Scene) -> Tensor:
    return rasterization(**scene)[0]


@properties
@given(scenes64)
def test_image_equals_the_oracle(scene: Scene) -> None:
    colors, alphas, _ = rasterization(**scene)
    expected, expected_alphas = reference(**scene)
    assert count_outliers(colors, expected, 1e-9) == 0
    assert count_outliers(alphas, expected_alphas, 1e-9) == 0


@properties
@given(scenes32, st.integers(0, 1000))
def test_order_of_the_input_does_not_matter(scene: Scene, seed: int) -> None:
    order = torch.randperm(len(scene["means"]), generator=torch.Generator().manual_seed(seed))
    assert torch.equal(image(scene), image(select(scene, order)))


@properties
@given(scenes32, st.sampled_from(["transparent", "behind", "beside", "beyond"]))
def test_an_invisible_gaussian_changes_nothing(scene: Scene, kind: str) -> None:
    more = select(scene, torch.cat([torch.tensor([0]), torch.arange(len(scene["means"]))]))
    distance = {"transparent": 0.0, "behind": -9.0, "beside": 0.0, "beyond": 60.0}[kind]
    one = {k: more[k][:1] for k in ("viewmats", "Ks", "backgrounds")}
    scene, more = {**scene, **one}, {**more, **one}
    axes = more["viewmats"][0, :3, :3]
    more["means"][0] = axes[2] * distance + axes[0] * (100.0 if kind == "beside" else 0.0)
    if kind == "transparent":
        more["opacities"][0] = 0
    if kind == "beyond":
        scene, more = {**scene, "far_plane": 50.0}, {**more, "far_plane": 50.0}
    assert torch.equal(image(scene), image(more))


@properties
@given(scenes64, st.floats(-3, 3), st.floats(-1, 1), st.integers(0, 1000))
def test_moving_world_and_camera_together_leaves_the_image(
    scene: Scene, azimuth: float, lift: float, seed: int
) -> None:
    motion = torch.eye(4, dtype=torch.float64)
    motion[:3, :3] = look_at_rotation(azimuth, lift)
    motion[:3, 3] = torch.randn(3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    half = oracle.quat_to_matrix(scene["quats"]) * scene["scales"][:, None]
    turned = motion[:3, :3] @ half
    moved = {
        **scene,
        "means": scene["means"] @ motion[:3, :3].T + motion[:3, 3],
        "covars": (turned @ turned.transpose(1, 2)).contiguous(),
        "viewmats": (scene["viewmats"] @ torch.linalg.inv(motion)).contiguous(),
        "quats": None,
        "scales": None,
    }
    assert count_outliers(image(moved), image(scene), 1e-8) == 0


@properties
@given(scenes32)
def test_alpha_and_convex_colours_stay_in_range(scene: Scene) -> None:
    colors, alphas, _ = rasterization(**scene)
    assert 0 <= alphas.min() <= alphas.max() <= 1
    low = torch.minimum(scene["colors"].amin(), scene["backgrounds"].amin())
    high = torch.maximum(scene["colors"].amax(), scene["backgrounds"].amax())
    assert low - 1e-5 <= colors.min() <= colors.max() <= high + 1e-5


@properties
@given(scenes64, st.floats(-2, 2), st.integers(0, 1000))
def test_image_is_linear_in_colour(scene: Scene, factor: float, seed: int) -> None:
    scene = {**scene, "backgrounds": None}
    shape = scene["colors"].shape
    other = torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    summed = image({**scene, "colors": scene["colors"] + factor * other})
    parts = image(scene) + factor * image({**scene, "colors": other})
    torch.testing.assert_close(summed, parts, atol=COLOR_ATOL, rtol=0)


@properties
@given(st.integers(0, 10**6), st.integers(1, 39))
def test_an_image_may_be_rendered_in_two_parts(seed: int, cut: int) -> None:
    # Orthographic: the clamp of the pinhole Jacobian depends on the image's size.
    scene = random_scene(seed, width=40, height=24, camera_model="ortho", dtype=torch.float64)
    shifted = scene["Ks"].clone()
    shifted[:, 0, 2] -= cut
    left, right = image({**scene, "width": cut}), image({**scene, "width": 40 - cut, "Ks": shifted})
    assert count_outliers(torch.cat([left, right], 2), image(scene), 1e-9) == 0


@properties
@given(scenes32, st.sampled_from([8, 32]))
def test_tile_size_does_not_show(scene: Scene, tile_size: int) -> None:
    assert torch.equal(image({**scene, "tile_size": tile_size}), image(scene))


@properties
@given(scenes64, st.floats(0.01, 100))
def test_quaternions_need_not_be_unit(scene: Scene, length: float) -> None:
    assert count_outliers(image({**scene, "quats": scene["quats"] * length}), image(scene), 1e-9) == 0


@properties
@given(scenes64, st.floats(0.1, 10))
def test_the_unit_of_length_is_free(scene: Scene, unit: float) -> None:
    # Orthographic cameras measure pixels per metre, pinhole ones do not.
    scaled = {**scene, "means": scene["means"] * unit, "scales": scene["scales"] * unit}
    scaled["viewmats"] = scene["viewmats"].clone()
    scaled["viewmats"][:, :3, 3] *= unit
    scaled |= {"near_plane": 0.01 * unit, "far_plane": 1e10 * unit}
    if scene["camera_model"] == "ortho":
        scaled["Ks"] = scene["Ks"].clone()
        scaled["Ks"][:, [0, 1], [0, 1]] /= unit
    assert count_outliers(image(scaled), image(scene), 1e-8) == 0


def test_hypothesis_scenes_show_something() -> None:
    scene = convert({**random_scene(0), **cameras(1, 40, 33)}, torch.float32)
    assert rasterization(**scene)[1].mean() > 0.1
