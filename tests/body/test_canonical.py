"""The canonical pose and the landmarks on the body."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from ahoy_core.body.canonical import canonical_pose, canonical_transl
from ahoy_core.body.keypoints import LANDMARK_NAMES, keypoints
from ahoy_core.body.model import BodyOutput
from ahoy_core.body.packaged import PackagedBody, load_packaged_body
from ahoy_core.conventions import canonical_cameras


@pytest.fixture(scope="module")
def body() -> PackagedBody:
    return load_packaged_body()


@pytest.fixture(scope="module")
def posed(body: PackagedBody) -> BodyOutput:
    return body(canonical_pose(body)[None], body.default_betas[None], canonical_transl(body)[None])


def joint(body: PackagedBody, output: BodyOutput, name: str) -> Tensor:
    return output.joints[0, body.joint_names.index(name)]


@pytest.mark.parametrize(("side", "sign"), [("L", 1.0), ("R", -1.0)])
def test_arms_are_straight_and_45_degrees_down(body: PackagedBody, posed: BodyOutput, side: str, sign: float) -> None:
    for start, end in (("upperarm01", "lowerarm01"), ("lowerarm01", "wrist")):
        bone = joint(body, posed, f"{end}.{side}") - joint(body, posed, f"{start}.{side}")
        expected = torch.tensor([sign, 0.0, -1.0]) / math.sqrt(2)
        torch.testing.assert_close(bone / bone.norm(), expected, atol=1e-4, rtol=0)


def test_feet_stand_apart_by_about_the_width_of_the_shoulders(body: PackagedBody, posed: BodyOutput) -> None:
    feet = joint(body, posed, "foot.L")[0] - joint(body, posed, "foot.R")[0]
    shoulders = joint(body, posed, "upperarm01.L")[0] - joint(body, posed, "upperarm01.R")[0]
    assert 0.9 < float(feet / shoulders) < 1.3


def test_soles_are_flat_on_the_floor_and_the_root_is_upright(body: PackagedBody, posed: BodyOutput) -> None:
    vertices = posed.vertices[0]
    assert abs(float(vertices[:, 2].min())) < 1e-5
    for half in (vertices[:, 0] > 0, vertices[:, 0] < 0):
        foot = vertices[body.regions["feet"] & half]
        low = foot[foot[:, 2] < 0.01]
        assert float(low[:, 1].max() - low[:, 1].min()) > 0.15, "heel and toes both touch"
    for side in "LR":
        foot_axes = posed.transforms[0, body.joint_names.index(f"foot.{side}"), :3, :3]
        torch.testing.assert_close(foot_axes[2], torch.tensor([0.0, 0.0, 1.0]), atol=1e-5, rtol=0)
    torch.testing.assert_close(canonical_pose(body)[0], torch.zeros(3), atol=1e-6, rtol=0)


def test_it_is_symmetric_and_constant(body: PackagedBody, posed: BodyOutput) -> None:
    mirrored = posed.vertices[0, body.mirror_index] * torch.tensor([-1.0, 1.0, 1.0])
    torch.testing.assert_close(mirrored, posed.vertices[0], atol=1e-4, rtol=0)
    assert torch.equal(canonical_pose(body), canonical_pose(body))


def test_front_and_back_see_most_of_the_surface(body: PackagedBody, posed: BodyOutput) -> None:
    trimesh = pytest.importorskip("trimesh")
    outside = ~body.face_regions["interior"]
    vertices = posed.vertices[0].numpy()
    mesh = trimesh.Trimesh(vertices, body.faces.numpy(), process=False)
    cameras = canonical_cameras(posed.vertices, 64, 64)
    seen = np.zeros(len(mesh.faces), dtype=bool)
    for view in (0, 2):
        towards = -cameras.viewmats[view, 2, :3].numpy()
        facing = mesh.face_normals @ towards > 0.15
        origins = mesh.triangles_center + 1e-5 * mesh.face_normals
        seen |= facing & ~mesh.ray.intersects_any(origins, np.broadcast_to(towards, origins.shape))
    keep = outside.numpy()
    assert mesh.area_faces[seen & keep].sum() / mesh.area_faces[keep].sum() > 0.75


def test_landmarks_lie_where_their_names_say(body: PackagedBody, posed: BodyOutput) -> None:
    points = dict(zip(LANDMARK_NAMES, keypoints(body, posed)[0], strict=True))
    near = {
        "left_shoulder": ("upperarm01.L", 0.07),
        "right_elbow": ("lowerarm01.R", 0.05),
        "left_wrist": ("wrist.L", 0.05),
        "right_hip": ("upperleg01.R", 0.1),
        "left_knee": ("lowerleg01.L", 0.05),
        "right_ankle": ("foot.R", 0.05),
        "left_index": ("finger2-1.L", 0.02),
        "right_pinky": ("finger5-1.R", 0.02),
        "left_thumb": ("finger1-2.L", 0.02),
        "left_eye": ("eye.L", 0.03),
    }
    for name, (bone, bound) in near.items():
        assert (points[name] - joint(body, posed, bone)).norm() < bound, name
    assert min(points, key=lambda name: float(points[name][1])) in ("left_foot_index", "right_foot_index")
    face = LANDMARK_NAMES[:11]
    assert min(face, key=lambda name: float(points[name][1])) == "nose"
    for left in [name for name in LANDMARK_NAMES if "left" in name]:
        mirrored = points[left.replace("left", "right")] * torch.tensor([-1.0, 1.0, 1.0])
        torch.testing.assert_close(points[left], mirrored, atol=5e-3, rtol=0)
        assert points[left][0] > 0
    xs = [float(points[f"left_eye{part}"][0]) for part in ("_inner", "", "_outer")]
    assert xs == sorted(xs)
    assert points["mouth_left"][2] < points["nose"][2] < points["left_eye"][2]
    assert points["left_heel"][1] > points["left_ankle"][1] - 0.01 > points["left_foot_index"][1]


def test_landmarks_follow_a_rigid_motion_and_pass_gradients(body: PackagedBody, posed: BodyOutput) -> None:
    pose, transl = canonical_pose(body)[None].clone(), torch.zeros(1, 3)
    here = keypoints(body, body(pose, body.default_betas[None], transl))
    transl = torch.tensor([[1.0, 2.0, 3.0]], requires_grad=True)
    there = keypoints(body, body(pose, body.default_betas[None], transl))
    torch.testing.assert_close(there - here, torch.tensor([1.0, 2.0, 3.0]).expand_as(here), atol=1e-5, rtol=0)
    (gradient,) = torch.autograd.grad(there.sum(), transl)
    torch.testing.assert_close(gradient, torch.full((1, 3), 33.0), atol=1e-3, rtol=0)


def test_landmark_weights_are_convex(body: PackagedBody) -> None:
    assert body.landmark_indices.shape == body.landmark_weights.shape == (33, body.landmark_weights.shape[1])
    assert body.landmark_names == LANDMARK_NAMES
    assert (body.landmark_weights >= 0).all()
    torch.testing.assert_close(body.landmark_weights.sum(1), torch.ones(33))
