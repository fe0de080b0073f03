"""The packaged body: against the library it was compiled from, and by its properties."""

from __future__ import annotations

import math
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from ahoy_core.body.keypoints import keypoints
from ahoy_core.body.lbs import lbs
from ahoy_core.body.model import BodyModel
from ahoy_core.body.packaged import PackagedBody, load_packaged_body
from ahoy_core.body.phenotype import ANCHOR_COUNTS, corner_weights
from ahoy_core.body.regions import faces_within
from ahoy_core.body.rotations import axis_angle_to_matrix

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


def test_skin_weights_are_convex(body: PackagedBody) -> None:
    torch.testing.assert_close(body.lbs_weights.sum(1), torch.ones(body.n_vertices))
    assert (body.lbs_weights >= 0).all()


def test_zero_pose_is_the_rest_body(body64: PackagedBody) -> None:
    betas, expression = (x[:1] for x in random_input(body64, 1)[1::2])
    zero = torch.zeros(1, body64.n_joints, 3, dtype=torch.float64)
    output = body64(zero, betas, zero[:, 0], expression)
    torch.testing.assert_close(output.vertices, output.rest_vertices, atol=1e-14, rtol=0)
    torch.testing.assert_close(output.joints, output.rest_joints, atol=1e-14, rtol=0)


def test_transl_moves_everything_and_nothing_else(body64: PackagedBody) -> None:
    pose, betas, transl, expression = random_input(body64, 2)
    here = body64(pose, betas, torch.zeros_like(transl), expression)
    there = body64(pose, betas, transl, expression)
    torch.testing.assert_close(there.vertices - transl[:, None], here.vertices)
    torch.testing.assert_close(there.joints - transl[:, None], here.joints)


def test_a_full_turn_of_the_root_leaves_the_local_shape_identical(body64: PackagedBody) -> None:
    pose, betas, transl, expression = random_input(body64, 1)
    angles = torch.linspace(0, 2 * math.pi, 9, dtype=torch.float64)
    turned = pose.expand(9, -1, -1).clone()
    turned[:, 0] = torch.stack([0 * angles, 0 * angles, angles], dim=-1)
    output = body64(turned, betas, transl.expand(9, -1), expression)
    root = axis_angle_to_matrix(turned[:, 0])
    local = (output.vertices - output.joints[:, :1]) @ root
    torch.testing.assert_close(local, local[:1].expand_as(local), atol=1e-9, rtol=0)
    torch.testing.assert_close(output.vertices[-1], output.vertices[0], atol=1e-9, rtol=0)


def test_transforms_are_what_skinning_blends(body64: PackagedBody) -> None:
    output = body64(*random_input(body64, 2))
    torch.testing.assert_close(lbs(output.rest_vertices, body64.lbs_weights, output.transforms), output.vertices)


def test_one_shape_serves_many_poses(body: PackagedBody) -> None:
    pose, betas, transl, expression = random_input(body, 3)
    shared = body(pose, betas[:1], transl, expression[:1])
    repeated = body(pose, betas[:1].expand(3, -1), transl, expression[:1].expand(3, -1))
    torch.testing.assert_close(shared.vertices, repeated.vertices, atol=1e-5, rtol=0)
    assert shared.rest_vertices.shape == shared.vertices.shape


def test_gradients_pass_gradcheck_through_pose_shape_translation_and_expression(body64: PackagedBody) -> None:
    few = body64.subset(torch.arange(0, body64.n_vertices, 4000))
    pose, betas, transl, expression = random_input(few, 1)
    pose[:, 5:60] = 0
    inputs = tuple(x.requires_grad_() for x in (pose, 0.05 + 0.4 * betas, transl, expression))
    weights = torch.randn(len(few.lbs_weights), 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)

    def scalar(*given: Tensor) -> Tensor:
        output = few(*given)
        return (output.vertices * weights).sum() + output.joints.square().sum()

    assert torch.autograd.gradcheck(scalar, inputs)


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


def test_triangles_face_outwards(body: PackagedBody) -> None:
    vertices = body.shape(body.default_betas[None])[0][0]
    a, b, c = vertices[body.faces].unbind(1)
    volume = (a * torch.linalg.cross(b, c)).sum() / 6
    assert 0.03 < float(volume) < 0.15, "cubic metres, positive for counter-clockwise from outside"


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


def test_a_subset_is_the_body_at_its_vertices(body: PackagedBody) -> None:
    given = random_input(body, 2)
    whole = body(*given)
    indices = torch.cat([body.landmark_indices.unique(), torch.arange(0, body.n_vertices, 50)]).unique()
    part = body.subset(indices)
    output = part(*given)
    torch.testing.assert_close(output.vertices, whole.vertices[:, indices], atol=1e-5, rtol=0)
    torch.testing.assert_close(keypoints(part, output), keypoints(body, whole), atol=1e-5, rtol=0)
    torch.testing.assert_close(indices[part.faces], body.faces[faces_within(body.faces, part_mask(body, indices))])


def part_mask(body: PackagedBody, indices: Tensor) -> Tensor:
    mask = torch.zeros(body.n_vertices, dtype=torch.bool)
    mask[indices] = True
    return mask


def test_landmarks_of_a_subset_without_them_are_refused(body: PackagedBody) -> None:
    part = body.subset(torch.arange(10))
    with pytest.raises(ValueError, match="landmark vertices"):
        keypoints(part, part(*random_input(part, 1)))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"pose": torch.zeros(1, 55, 3)}, "convert_pose"),
        ({"betas": torch.zeros(1, 10)}, r"betas \[B,6\]"),
        ({"betas": torch.zeros(6)}, r"betas \[B,6\]"),
        ({"betas": torch.zeros(3, 6)}, "as many expressions as betas"),
        ({"betas": torch.zeros(3, 6), "expression": None}, "one shape or 2"),
        ({"transl": torch.zeros(1, 3)}, r"transl \[2,3\]"),
        ({"expression": torch.zeros(2, 10)}, r"expression \[B,52\]"),
    ],
)
def test_wrong_sizes_are_refused_by_name(body: PackagedBody, change: dict[str, Tensor | None], message: str) -> None:
    given: dict[str, Any] = dict(zip(("pose", "betas", "transl", "expression"), random_input(body, 2), strict=True))
    with pytest.raises(ValueError, match=message):
        body(**{**given, **change})


def test_half_precision_is_refused() -> None:
    with pytest.raises(ValueError, match="float32 or float64"):
        load_packaged_body(dtype=torch.float16)
