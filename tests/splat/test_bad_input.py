"""Bad input is refused with the argument's name, what was expected, what came and what to do."""

from __future__ import annotations

import re
from typing import Any

import pytest
import torch
from torch import Tensor

from ahoy_core.splat import rasterization
from tests.splat.scenes import Scene, random_scene

SHAPES: dict[str, list[tuple[int, ...]]] = {
    "means": [(20,), (20, 2), (1, 20, 3)],
    "quats": [(20, 3), (19, 4)],
    "scales": [(20,), (20, 1), (21, 3)],
    "opacities": [(20, 1), (19,)],
    "colors": [(20,), (19, 3), (3, 20, 3)],
    "viewmats": [(4, 4), (2, 3, 4), (0, 4, 4)],
    "Ks": [(3, 3), (2, 4, 4), (1, 3, 3)],
    "backgrounds": [(3,), (1, 3), (2, 4)],
}
WRONG_SHAPES = [(name, shape) for name, shapes in SHAPES.items() for shape in shapes]


def refused(scene: Scene, name: str, error: type[Exception] | tuple[type[Exception], ...] = ValueError) -> str:
    """Message of the refusal, which must name the argument, say expected and got, and end with advice."""
    with pytest.raises(error) as info:
        rasterization(**scene)
    message = str(info.value)
    assert name in message, message
    assert re.search(r"expected .+?, got .+?[:;] .+", message, re.DOTALL), message
    return message


@pytest.mark.parametrize(("name", "shape"), WRONG_SHAPES, ids=str)
def test_wrong_shape(name: str, shape: tuple[int, ...]) -> None:
    scene = random_scene(0, n=20, count=2)
    scene[name] = torch.rand(shape)
    assert str(tuple(shape)).strip("()") in refused(scene, name)


def test_wrong_shape_of_covars() -> None:
    scene = random_scene(0, n=20, covars=True)
    refused({**scene, "covars": torch.rand(20, 6)}, "covars")


def test_too_few_coefficients_for_the_degree() -> None:
    scene = random_scene(0, n=20, sh_degree=3)
    refused({**scene, "colors": torch.rand(20, 9, 3)}, "colors")


@pytest.mark.parametrize("name", ["means", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "backgrounds"])
@pytest.mark.parametrize("dtype", [torch.float16, torch.int64])
def test_wrong_dtype(name: str, dtype: torch.dtype) -> None:
    scene = random_scene(0, n=20)
    assert str(dtype) in refused({**scene, name: scene[name].to(dtype)}, name, (TypeError, ValueError))


@pytest.mark.parametrize("name", ["quats", "scales", "opacities", "colors", "backgrounds"])
def test_mixed_dtype(name: str) -> None:
    scene = random_scene(0, n=20)
    refused({**scene, name: scene[name].double()}, name, (TypeError, ValueError))


@pytest.mark.parametrize("name", ["means", "colors", "Ks"])
def test_not_a_tensor(name: str) -> None:
    scene = random_scene(0, n=20)
    refused({**scene, name: scene[name].numpy()}, name, (TypeError, ValueError))


@pytest.mark.parametrize("name", ["quats", "opacities", "viewmats", "backgrounds"])
def test_wrong_device(name: str) -> None:
    scene = random_scene(0, n=20)
    assert "meta" in refused({**scene, name: scene[name].to("meta")}, name)


@pytest.mark.parametrize("name", ["means", "quats", "scales", "colors", "viewmats", "Ks"])
def test_non_contiguous(name: str) -> None:
    scene = random_scene(0, n=20, count=2)
    strided = scene[name].transpose(0, 1).contiguous().transpose(0, 1)
    assert "contiguous" in refused({**scene, name: strided}, name)


def test_negative_scale_names_the_row() -> None:
    scene = random_scene(0, n=20)
    scene["scales"][13, 1] = -0.1
    assert "13" in refused(scene, "scales")


def singular(*entries: tuple[int, int, float]) -> Tensor:
    K = random_scene(0, n=1)["Ks"]
    for row, column, value in entries:
        K[0, row, column] = value
    return K


@pytest.mark.parametrize(
    "K",
    [singular((0, 0, 0.0)), singular((1, 1, 0.0)), singular((2, 2, 0.0)), singular((0, 0, float("nan"))),
     singular((1, 2, float("inf")))],
    ids=["fx 0", "fy 0", "last 0", "fx nan", "cy inf"],
)  # fmt: skip
def test_singular_intrinsics(K: Tensor) -> None:
    refused({**random_scene(0, n=20), "Ks": K}, "Ks")


def test_intrinsics_with_skew_are_refused_and_not_ignored() -> None:
    refused({**random_scene(0, n=20), "Ks": singular((0, 1, 2.0))}, "Ks")


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_broken_pose(value: float) -> None:
    scene = random_scene(0, n=20)
    scene["viewmats"][0, 1, 3] = value
    refused(scene, "viewmats")


@pytest.mark.parametrize("name", ["width", "height"])
@pytest.mark.parametrize("value", [0, -3])
def test_empty_image(name: str, value: int) -> None:
    refused({**random_scene(0, n=20), name: value}, name)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("render_mode", "rgb"),
        ("rasterize_mode", "mip"),
        ("camera_model", "fisheye"),
        ("sh_degree", 4),
        ("sh_degree", -1),
        ("tile_size", 0),
        ("tile_size", 7),
        ("eps2d", -0.1),
        ("near_plane", float("nan")),
        ("far_plane", 0.001),
        ("num_threads", 0),
    ],
)
def test_options_out_of_range(name: str, value: Any) -> None:
    scene = random_scene(0, n=20)
    if name == "sh_degree":
        scene["colors"] = torch.rand(20, 25, 3)
    refused({**scene, name: value}, name)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("distributed", True),
        ("sparse_grad", True),
        ("absgrad", True),
        ("with_ut", True),
        ("with_eval3d", True),
        ("radial_coeffs", torch.zeros(1, 6)),
        ("tangential_coeffs", torch.zeros(1, 2)),
        ("thin_prism_coeffs", torch.zeros(1, 4)),
        ("viewmats_rs", torch.eye(4)[None]),
    ],
)
def test_what_gsplat_has_and_this_has_not_is_refused_by_name(name: str, value: Any) -> None:
    with pytest.raises((NotImplementedError, ValueError, TypeError), match=name):
        rasterization(**random_scene(0, n=20), **{name: value})


def test_shape_and_covariance_may_not_both_be_missing() -> None:
    scene = random_scene(0, n=20)
    refused({**scene, "quats": None, "scales": None}, "covars")
