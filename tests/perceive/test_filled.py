"""Models that fill pose, mask and head: parameters carried over to our bodies, and what perceive does with them."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ahoy_core.body.packaged import load_packaged_body
from ahoy_core.body.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from ahoy_core.body.smpl import SmplBody
from ahoy_core.body.smpl_load import load_smpl
from ahoy_core.body.smpl_names import JOINT_NAMES, smpl_parents
from ahoy_core.conventions import OBSERVED_VIEWMAT
from ahoy_core.models.contracts import PoseEstimate
from ahoy_core.perceive.adopt import adopt, fit_shape, skeleton_of
from ahoy_core.perceive.filled import heads_by, masks_by
from tests.body import licensed

FILE = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # the file's axes -> ours


@pytest.fixture(scope="module")
def smplx(tmp_path_factory: pytest.TempPathFactory) -> SmplBody:
    return load_smpl(licensed.write(tmp_path_factory.mktemp("smplx"), "smplx"))


def stated(body: SmplBody, pose: torch.Tensor, transl: torch.Tensor) -> PoseEstimate:
    """What a model that speaks the file's axes and the camera's would say of a posed body of ours."""
    out = body(pose, body.default_betas[None], transl)
    to_camera = OBSERVED_VIEWMAT[:3, :3]
    rotations = axis_angle_to_matrix(pose)
    file = FILE.T @ rotations @ FILE
    file[:, 0] = to_camera @ rotations[:, 0] @ FILE
    n, joints = pose.shape[:2]
    return PoseEstimate(
        "smplx", matrix_to_axis_angle(file), torch.zeros(n, 10), out.joints @ to_camera.T,
        torch.full((n, joints), 0.01), torch.ones(n, dtype=torch.bool),
    )  # fmt: skip


def some_poses(body: SmplBody, count: int = 3) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    pose = 0.3 * torch.randn(count, body.n_joints, 3, generator=generator)
    return pose, torch.tensor([0.2, 3.0, 0.1]) + 0.1 * torch.randn(count, 3, generator=generator)


@pytest.mark.parametrize("kind", ["smpl", "smplx"])
def test_the_familys_tree_is_that_of_its_files(kind: str) -> None:
    assert list(smpl_parents(JOINT_NAMES[kind])) == licensed.parents(kind)


def test_a_body_of_the_same_family_stands_as_it_was_stated(smplx: SmplBody) -> None:
    pose, transl = some_poses(smplx)
    found = adopt(stated(smplx, pose, transl), smplx)
    ours, theirs = (
        smplx(p, smplx.default_betas[None], t).vertices for p, t in ((found.pose, found.transl), (pose, transl))
    )
    assert float((ours - theirs).abs().max()) < 1e-4, "a tenth of a millimetre: float32 rotations over 55 joints"


def test_the_skeleton_that_an_estimate_implies_is_the_bodys_own(smplx: SmplBody) -> None:
    skeleton, _ = skeleton_of(stated(smplx, *some_poses(smplx)))
    rest = smplx(torch.zeros(1, smplx.n_joints, 3), smplx.default_betas[None], torch.zeros(1, 3)).rest_joints[0]
    assert float((skeleton.rest_joints - (rest - rest[:1])).abs().max()) < 1e-5


def test_the_packaged_body_takes_the_pose_and_the_size(smplx: SmplBody) -> None:
    pose, transl = some_poses(smplx)
    body = load_packaged_body()
    found = adopt(stated(smplx, pose, transl), body)
    assert float(found.betas.min()) >= 0 and float(found.betas.max()) <= 1
    theirs = smplx(pose, smplx.default_betas[None], transl).joints
    ours = body(found.pose, found.betas[None], found.transl).joints
    for name, partner in (("wrist.L", "left_wrist"), ("foot.R", "right_ankle"), ("lowerarm01.R", "right_elbow")):
        gap = ours[:, body.joint_names.index(name)] - theirs[:, smplx.joint_names.index(partner)]
        # The two bodies have other proportions: a hand's breadth, where a wrong axis would be a metre.
        assert float(gap.norm(dim=1).max()) < 0.2, (name, gap.norm(dim=1))


def test_longer_limbs_make_a_taller_packaged_body(smplx: SmplBody) -> None:
    body = load_packaged_body()
    skeleton, _ = skeleton_of(stated(smplx, *some_poses(smplx, 1)))
    still = torch.zeros(1, body.n_joints, 3)
    heights = []
    for scale in (0.9, 1.1):
        sized = skeleton.__class__(skeleton.joint_names, skeleton.parents, scale * skeleton.rest_joints, "T of SMPL")
        vertices = body(still, fit_shape(body, sized)[None], torch.zeros(1, 3)).vertices[0, :, 2]
        heights.append(float(vertices.max() - vertices.min()))
    assert heights[1] > 1.08 * heights[0]


def test_frames_in_which_nobody_was_found_repeat_their_neighbour(smplx: SmplBody) -> None:
    estimate = stated(smplx, *some_poses(smplx))
    estimate.found[1] = False
    estimate.pose[1], estimate.joints[1] = 0, 0
    found = adopt(estimate, smplx)
    assert torch.equal(found.pose[1], found.pose[0]) and bool(torch.isfinite(found.pose).all())
    with pytest.raises(ValueError, match="find the subject in some frame"):
        estimate.found[:] = False
        adopt(estimate, smplx)


def test_masks_are_asked_for_shot_by_shot_and_only_where_the_subject_is() -> None:
    asked = []

    def mask(frames: torch.Tensor, boxes: torch.Tensor) -> torch.Tensor:
        asked.append(frames[:, 0, 0, 0].mul(255).round().int().tolist())
        return frames[:, :1]

    frames = np.zeros((5, 8, 8, 3), np.uint8) + np.arange(5, dtype=np.uint8)[:, None, None, None]
    boxes = torch.zeros(5, 4)
    boxes[2] = float("nan")
    soft = masks_by(mask, frames, boxes, np.array([0, 0, 1, 2, 2]))
    assert asked == [[0, 1], [3, 4]]
    assert soft[:, 0, 0].tolist() == [0, 1, 0, 3, 4]


def test_a_head_is_nowhere_above_the_visible_person() -> None:
    visible = np.array([[[0, 100], [200, 255]]], np.uint8)
    heads = heads_by(lambda frames, masks: torch.ones_like(masks), np.zeros((1, 2, 2, 3), np.uint8), visible)
    assert np.array_equal(heads, visible)
