"""The packaged body: against the library it was compiled from, and by its properties."""

from __future__ import annotations

import math
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from ahoy_core.body.model import BodyModel
from ahoy_core.body.packaged import PackagedBody, load_packaged_body
from ahoy_core.body.phenotype import ANCHOR_COUNTS, corner_weights
from ahoy_core.body.regions import faces_within

GOLDEN = Path(__file__).with_name("golden_anny.npz")
TENTH_OF_A_MILLIMETRE = 1e-4


@pytest.fixture(scope="module")
def body() -> PackagedBody:
    return load_packaged_body()


@pytest.fixture(scope="module")
def body64() -> PackagedBody:
    return load_packaged_body(dtype=torch.float64)


def random_input(body: PackagedBody, batch: int, seed: int = 0) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    rng = torch.Generator().manual_seed(seed)
    dtype = body.default_betas.dtype
    pose = 0.3 * torch.randn(batch, body.n_joints, 3, generator=rng, dtype=dtype)
    betas, expression = (torch.rand(batch, size, generator=rng, dtype=dtype) for size in (6, 52))
    return pose, betas, torch.randn(batch, 3, generator=rng, dtype=dtype), expression


def test_it_is_a_body_model_with_consistent_sizes(body: PackagedBody) -> None:
    assert isinstance(body, BodyModel)
    assert len(body.parents) == len(body.joint_names) == body.n_joints == body.lbs_weights.shape[1]
    assert body.faces.dtype == body.uv_faces.dtype == torch.int64
    assert body.faces.shape == body.uv_faces.shape
    assert body.faces.max() == body.n_vertices - 1
    assert body.uv_faces.max() == len(body.uvs) - 1
    assert body.default_betas.shape == (body.n_betas,)
    assert len(body.expression_names) == body.n_expressions == 52
    assert {"jawOpen", "eyeBlinkLeft", "mouthSmileRight"} <= set(body.expression_names)


def test_asset_is_under_ten_megabytes() -> None:
    folder = resources.files("ahoy_core.assets")
    assert sum(len(folder.joinpath(f"body.{end}").read_bytes()) for end in ("safetensors", "json")) < 10e6


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_vertices_and_joints_are_the_librarys_within_a_tenth_of_a_millimetre(dtype: torch.dtype) -> None:
    body = load_packaged_body(dtype=dtype)
    with np.load(GOLDEN) as golden:
        pose, betas, root, expression, vertices, joints = (
            torch.from_numpy(golden[key]).to(dtype)
            for key in ("pose", "betas", "root", "expression", "vertices", "joints")
        )
        indices = torch.from_numpy(golden["indices"])
    output = body(pose, betas, root - body.shape(betas, expression)[1][:, 0], expression)
    assert (output.vertices[:, indices] - vertices).norm(dim=-1).max() < TENTH_OF_A_MILLIMETRE
    assert (output.joints - joints).norm(dim=-1).max() < TENTH_OF_A_MILLIMETRE


@pytest.mark.slow
def test_all_vertices_are_the_live_librarys_over_random_draws_and_all_corner_shapes() -> None:
    paths = pytest.importorskip("anny.paths")
    if not paths.get_anny_cache_path().is_dir():
        pytest.skip("needs anny's cache (0.8 GB, minutes): run `python -m ahoy_core.body.compile --out DIR` once")
    from ahoy_core.body import compile as compiler

    model = compiler.library()
    kept = compiler.kept_joints(model.bone_labels)
    body = load_packaged_body(dtype=torch.float64)
    given = compiler.random_parameters(seed=99, count=8, n_bones=len(model.bone_labels), kept=kept)
    vertices, heads = compiler.library_output(model, given)
    transl = given["root"] - body.shape(given["betas"], given["expression"])[1][:, 0]
    output = body(given["pose"][:, kept], given["betas"], transl, given["expression"])
    assert (output.vertices - vertices).norm(dim=-1).max() < TENTH_OF_A_MILLIMETRE
    assert (output.joints - heads[:, kept]).norm(dim=-1).max() < TENTH_OF_A_MILLIMETRE
    corners, _ = compiler.corner_states(model)
    rest = body.mean_vertices + torch.einsum("cr,rvd->cvd", body.corner_coefficients, body.shape_basis)
    assert (rest - corners).norm(dim=-1).max() < TENTH_OF_A_MILLIMETRE


@pytest.mark.parametrize("value", [0.0, 1 / 3, 0.5, 2 / 3, 1.0])
def test_every_phenotype_has_a_finite_live_gradient_at_anchors(body: PackagedBody, value: float) -> None:
    betas = torch.full((1, 6), value)
    betas[0, 1] = max(value, 1 / 3)  # babies come in one proportion only
    betas.requires_grad_()
    vertices, _ = body.shape(betas)
    weights = torch.randn(vertices.shape, generator=torch.Generator().manual_seed(0))
    (gradient,) = torch.autograd.grad((vertices * weights).sum(), betas)
    assert torch.isfinite(gradient).all()
    assert (gradient.abs() > 1e-4).all()


def test_corner_weights_sum_to_one_and_pick_corners() -> None:
    rng = torch.Generator().manual_seed(0)
    weights = corner_weights(torch.rand(50, 6, generator=rng, dtype=torch.float64))
    torch.testing.assert_close(weights.sum(1), torch.ones(50, dtype=torch.float64))
    assert weights.shape[1] == math.prod(ANCHOR_COUNTS)
    assert int(corner_weights(torch.ones(1, 6)).argmax()) == math.prod(ANCHOR_COUNTS) - 1
    torch.testing.assert_close(corner_weights(torch.full((1, 6), 7.0)), corner_weights(torch.ones(1, 6)))


def test_adult_is_upright_faces_minus_y_and_has_the_left_hand_at_plus_x(body: PackagedBody) -> None:
    vertices, joints = body.shape(body.default_betas[None])
    height = vertices[0, :, 2].max() - vertices[0, :, 2].min()
    assert 1.5 < float(height) < 1.95
    joint = dict(zip(body.joint_names, joints[0], strict=True))
    assert joint["head"][2] > joint["root"][2] > joint["foot.L"][2]
    assert joint["wrist.L"][0] > 0.2
    assert joint["toe1-1.L"][1] < joint["foot.L"][1] - 0.05
    assert vertices[0, body.regions["eyes"], 1].max() < joint["head"][1]


def test_texture_coordinates_fill_the_unit_square_without_degenerate_charts(body: PackagedBody) -> None:
    assert body.uvs.min() >= 0
    assert body.uvs.max() <= 1
    a, b, c = body.uvs.double()[body.uv_faces].unbind(1)
    area = 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]).abs()
    assert 0.4 < float(area.sum()) < 1.0
    assert (area > 0).all()


def test_regions_are_where_they_should_be(body: PackagedBody) -> None:
    vertices = body.shape(body.default_betas[None])[0][0]
    low, high = vertices[:, 2].min(), vertices[:, 2].max()
    height = (vertices[:, 2] - low) / (high - low)
    regions = body.regions
    assert height[regions["head"]].min() > 0.8
    assert height[regions["feet"]].max() < 0.1
    assert vertices[regions["hands"], 0].abs().min() > 0.3
    assert (regions["interior"] & ~regions["head"]).sum() == 0
    assert not (regions["interior"] & regions["eyes"]).any()
    assert 0.05 < regions["interior"].float().mean() < 0.15
    for name, mask in body.face_regions.items():
        assert mask.shape == (len(body.faces),), name
    assert not faces_within(body.faces, regions["interior"])[~body.face_regions["interior"]].any()


def test_the_mirrored_body_is_the_body(body: PackagedBody) -> None:
    vertices = body.shape(body.default_betas[None])[0][0]
    mirrored = vertices[body.mirror_index] * torch.tensor([-1.0, 1.0, 1.0])
    torch.testing.assert_close(mirrored, vertices, atol=1e-5, rtol=0)
    assert torch.equal(body.mirror_index[body.mirror_index], torch.arange(body.n_vertices))


def test_expressions_move_the_face_only(body: PackagedBody) -> None:
    neutral = body.shape(body.default_betas[None])[0]
    every = body.shape(body.default_betas[None].expand(52, -1), torch.eye(52))[0]
    moved = (every - neutral).norm(dim=-1)
    assert (moved.amax(1) > 5e-4).all(), "each action does something"
    assert moved[:, body.regions["feet"] | body.regions["hands"]].max() < 1e-6, "round-off only"
