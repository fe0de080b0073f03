"""What every body model does, the packaged one and the SMPL family alike."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor

from ahoy_core.body.canonical import canonical_pose, canonical_transl
from ahoy_core.body.keypoints import LANDMARK_NAMES, keypoints
from ahoy_core.body.lbs import depth_levels, lbs
from ahoy_core.body.model import BodyModel
from ahoy_core.body.rotations import axis_angle_to_matrix
from ahoy_core.maps.template import build_template
from ahoy_core.texture.surface import Surface

ROUND_OFF = 1e-12  # of float64, over metres and some dozens of products


def random_input(body: BodyModel, batch: int, seed: int = 0) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    rng = torch.Generator().manual_seed(seed)
    dtype = body.default_betas.dtype
    pose = 0.3 * torch.randn(batch, body.n_joints, 3, generator=rng, dtype=dtype)
    betas, expression = (
        torch.rand(batch, size, generator=rng, dtype=dtype) for size in (body.n_betas, body.n_expressions)
    )
    return pose, betas, torch.randn(batch, 3, generator=rng, dtype=dtype), expression


def few_vertices(body: Any, count: int = 4) -> Any:
    return body.subset(torch.linspace(0, len(body.lbs_weights) - 1, count).long())


def test_it_fulfils_the_protocol_with_consistent_sizes(any_body: BodyModel) -> None:
    body = any_body
    assert isinstance(body, BodyModel)
    assert len(body.parents) == len(body.joint_names) == len(set(body.joint_names)) == body.n_joints
    depth_levels(body.parents)
    assert body.lbs_weights.shape == (int(body.faces.max()) + 1, body.n_joints)
    assert body.faces.dtype == body.uv_faces.dtype == torch.int64
    assert body.faces.shape == body.uv_faces.shape
    assert int(body.uv_faces.max()) < len(body.uvs)
    assert float(body.uvs.min()) >= 0 and float(body.uvs.max()) <= 1
    assert body.default_betas.shape == (body.n_betas,)
    assert len(body.expression_names) == body.n_expressions
    assert {"head", "hands", "feet", "interior"} <= set(body.regions)


def test_skin_weights_are_convex(any_body: BodyModel) -> None:
    weights = any_body.lbs_weights
    torch.testing.assert_close(weights.sum(1), torch.ones_like(weights[:, 0]))
    assert (weights >= 0).all()


def test_zero_pose_is_the_rest_body(any_body: BodyModel) -> None:
    pose, betas, transl, expression = random_input(any_body, 1)
    output = any_body(0 * pose, betas, 0 * transl, expression)
    torch.testing.assert_close(output.vertices, output.rest_vertices, atol=ROUND_OFF, rtol=0)
    torch.testing.assert_close(output.joints, output.rest_joints, atol=ROUND_OFF, rtol=0)


def test_transl_moves_everything_and_nothing_else(any_body: BodyModel) -> None:
    pose, betas, transl, expression = random_input(any_body, 2)
    here = any_body(pose, betas, torch.zeros_like(transl), expression)
    there = any_body(pose, betas, transl, expression)
    torch.testing.assert_close(there.vertices - transl[:, None], here.vertices)
    torch.testing.assert_close(there.joints - transl[:, None], here.joints)


def test_a_full_turn_of_the_root_leaves_the_local_shape_identical(any_body: BodyModel) -> None:
    pose, betas, transl, expression = random_input(any_body, 1)
    angles = torch.linspace(0, 2 * math.pi, 9, dtype=torch.float64)
    turned = pose.expand(9, -1, -1).clone()
    turned[:, 0] = torch.stack([0 * angles, 0 * angles, angles], dim=-1)
    output = any_body(turned, betas, transl.expand(9, -1), expression)
    local = (output.vertices - output.joints[:, :1]) @ axis_angle_to_matrix(turned[:, 0])
    torch.testing.assert_close(local, local[:1].expand_as(local), atol=1e-9, rtol=0)
    torch.testing.assert_close(output.vertices[-1], output.vertices[0], atol=1e-9, rtol=0)


def test_transforms_are_what_skinning_blends(any_body: BodyModel) -> None:
    output = any_body(*random_input(any_body, 2))
    torch.testing.assert_close(lbs(output.rest_vertices, any_body.lbs_weights, output.transforms), output.vertices)


def test_one_shape_serves_many_poses(any_body: BodyModel) -> None:
    pose, betas, transl, expression = random_input(any_body, 3)
    shared = any_body(pose, betas[:1], transl, expression[:1])
    repeated = any_body(pose, betas[:1].expand(3, -1), transl, expression[:1].expand(3, -1))
    torch.testing.assert_close(shared.vertices, repeated.vertices, atol=ROUND_OFF, rtol=0)
    assert shared.rest_vertices.shape == shared.vertices.shape
    assert shared.rest_joints.shape == shared.joints.shape


def test_gradients_pass_gradcheck_through_pose_shape_translation_and_expression(any_body: BodyModel) -> None:
    few = few_vertices(any_body)
    pose, betas, transl, expression = random_input(few, 1)
    pose[:, 5:] = 0  # most joints exactly at rest, where a careless Rodrigues formula divides by zero
    inputs = tuple(x.requires_grad_() for x in (pose, 0.05 + 0.4 * betas, transl, expression) if x.numel())
    weights = torch.randn(len(few.lbs_weights), 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)

    def scalar(*given: Tensor) -> Tensor:
        output = few(*given)
        return (output.vertices * weights).sum() + output.joints.square().sum()

    # fast_mode compares random projections of both Jacobians: 400 inputs would take a second each otherwise.
    assert torch.autograd.gradcheck(scalar, inputs, fast_mode=True)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("around", [0.0, math.pi, 2 * math.pi])
def test_values_and_gradients_are_finite_round_singular_rotations(
    any_body: BodyModel, around: float, dtype: torch.dtype
) -> None:
    """At 0, a half and a full turn, and a few units in the last place either side: the body stays where it was."""
    few = few_vertices(any_body, 40).to(dtype=dtype)
    step = torch.finfo(dtype).eps * max(around, 1e-3)
    angles = around + step * torch.arange(-4, 5, dtype=dtype)
    pose = torch.zeros(9, few.n_joints, 3, dtype=dtype)
    axis = torch.nn.functional.normalize(torch.tensor([0.3, -0.5, 0.8], dtype=dtype), dim=0)
    pose[:] = (angles[:, None] * axis)[:, None]
    pose.requires_grad_()
    output = few(pose, few.default_betas[None], torch.zeros(9, 3, dtype=dtype))
    (gradient,) = torch.autograd.grad((output.vertices.square().sum() + output.joints.sum()), pose)
    assert torch.isfinite(output.vertices).all() and torch.isfinite(gradient).all()
    # Every joint of a chain of up to a dozen turns by up to 8 steps; arms and legs are shorter than 2 m.
    assert (output.vertices - output.vertices[4]).abs().max() < 12 * 8 * 2 * max(step, torch.finfo(dtype).eps)


def test_a_subset_is_the_body_at_its_vertices(any_body: Any) -> None:
    given = random_input(any_body, 2)
    whole = any_body(*given)
    count = len(any_body.lbs_weights)
    indices = torch.cat([any_body.landmark_indices.unique(), torch.arange(0, count, 50)]).unique()
    part = any_body.subset(indices)
    output = part(*given)
    torch.testing.assert_close(output.vertices, whole.vertices[:, indices], atol=ROUND_OFF, rtol=0)
    torch.testing.assert_close(keypoints(part, output), keypoints(any_body, whole), atol=ROUND_OFF, rtol=0)
    kept = torch.zeros(count, dtype=torch.bool)
    kept[indices] = True
    torch.testing.assert_close(indices[part.faces], any_body.faces[kept[any_body.faces].all(1)])
    assert len(part.faces) == len(part.uv_faces)


def test_landmarks_of_a_subset_without_them_are_refused(any_body: Any) -> None:
    part = any_body.subset(torch.arange(10))
    with pytest.raises(ValueError, match="landmark vertices"):
        keypoints(part, part(*random_input(part, 1)))


def three(given: dict[str, Tensor]) -> dict[str, Tensor | None]:
    return {"betas": given["betas"][:1].expand(3, -1)}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda given: {"pose": torch.zeros(1, 3, 3)}, "convert_pose"),
        (lambda given: {"betas": torch.zeros(1, 17)}, r"betas \[B,\d+\]"),
        (lambda given: {"betas": given["betas"][0]}, r"betas \[B,\d+\]"),
        (three, "as many expressions as betas"),
        (lambda given: three(given) | {"expression": None}, "one shape or 2"),
        (lambda given: {"transl": torch.zeros(1, 3)}, r"transl \[2,3\]"),
        (lambda given: {"expression": torch.zeros(2, 11)}, r"expression \[B,\d+\]"),
    ],
)
def test_wrong_sizes_are_refused_by_name(any_body: BodyModel, change: Any, message: str) -> None:
    given = dict(zip(("pose", "betas", "transl", "expression"), random_input(any_body, 2), strict=True))
    with pytest.raises(ValueError, match=message):
        any_body(**{**given, **change(given)})


def test_triangles_face_outwards(any_body: BodyModel) -> None:
    still = any_body.default_betas.new_zeros(1, any_body.n_joints, 3)
    vertices = any_body(still, any_body.default_betas[None], still[:, 0]).vertices[0]
    a, b, c = vertices[any_body.faces].unbind(1)
    volume = (a * torch.linalg.cross(b, c)).sum() / 6
    assert 0.03 < float(volume) < 0.15, "cubic metres, positive for counter-clockwise from outside"


def test_in_canonical_pose_it_stands_on_the_floor_faces_minus_y_and_has_its_left_at_plus_x(any_body: BodyModel) -> None:
    pose, transl = canonical_pose(any_body), canonical_transl(any_body)
    output = any_body(pose[None], any_body.default_betas[None], transl[None])
    vertices, place = output.vertices[0], dict(zip(LANDMARK_NAMES, keypoints(any_body, output)[0], strict=True))
    assert abs(float(vertices[:, 2].min())) < 1e-9
    assert 1.4 < float(vertices[:, 2].max()) < 2
    for side, sign in (("left", 1), ("right", -1)):
        shoulder, elbow, wrist = (place[f"{side}_{part}"] for part in ("shoulder", "elbow", "wrist"))
        assert sign * float(shoulder[0]) > 0.1
        # Landmarks lie beside the joints by a centimetre or two, so "45 degrees" holds to a few degrees.
        for bone in (elbow - shoulder, wrist - elbow):
            assert math.degrees(math.atan2(-float(bone[2]), sign * float(bone[0]))) == pytest.approx(45, abs=8)
        assert float(place[f"{side}_heel"][1]) > float(place[f"{side}_foot_index"][1]) + 0.1
        assert float(place[f"{side}_heel"][2]) < 0.15 and float(place[f"{side}_foot_index"][2]) < 0.1
        assert float(place[f"{side}_ankle"][2]) < float(place[f"{side}_knee"][2]) < float(place[f"{side}_hip"][2])
        assert sign * float(place[f"{side}_eye"][0]) > 0.01
        assert sign * float(place[f"{side}_ear"][0]) > sign * float(place[f"{side}_eye"][0])
        assert float(place[f"{side}_thumb"][1]) < float(place[f"{side}_pinky"][1]), "palms turned in, thumbs ahead"
    assert float(place["nose"][1]) < float(place["left_ear"][1]) - 0.05
    assert float(place["mouth_left"][2]) < float(place["nose"][2]) < float(place["left_eye"][2])


def test_landmark_weights_are_convex(any_body: BodyModel) -> None:
    assert any_body.landmark_indices.shape == any_body.landmark_weights.shape
    assert any_body.landmark_indices.shape[0] == len(LANDMARK_NAMES)
    total = any_body.landmark_weights.sum(1)
    torch.testing.assert_close(total, torch.ones_like(total))
    assert (any_body.landmark_weights >= 0).all()


def test_regions_are_where_they_should_be(any_body: BodyModel) -> None:
    still = any_body.default_betas.new_zeros(1, any_body.n_joints, 3)
    vertices = any_body(still, any_body.default_betas[None], still[:, 0]).vertices[0]
    low, high = vertices[:, 2].min(), vertices[:, 2].max()
    height = (vertices[:, 2] - low) / (high - low)
    regions = any_body.regions
    assert height[regions["head"]].min() > 0.75
    assert height[regions["feet"]].max() < 0.2
    assert vertices[regions["hands"], 0].abs().min() > 0.3
    assert not (regions["interior"] & ~regions["head"]).any()


def test_maps_and_textures_can_be_laid_on_it(any_body: Any) -> None:
    body = any_body.to(dtype=torch.float32)
    assert Surface.of(body).textured.mean() > 0.8
    template = build_template(body, body.default_betas, map_size=32)
    assert torch.isfinite(template.means).all()
