from __future__ import annotations

import torch

from ahoy_core.avatar.corrections import Corrections, corrected_joints
from ahoy_core.avatar.full_config import CorrectionBounds, FullWeights
from ahoy_core.body.rotations import axis_angle_to_matrix, so3_exp, so3_log
from tests.avatar.full_scenes import around, kinematics, raised, seen
from tests.avatar.scenes import body

ROW = torch.tensor([0])
BOUNDS = CorrectionBounds()


def _corrections() -> Corrections:
    return Corrections(torch.tensor([False]), corrected_joints(body()), BOUNDS)


def test_corrected_joints_are_limbs_and_trunk_the_root_first():
    names = [body().joint_names[i] for i in corrected_joints(body()).tolist()]
    assert names[0] == "root"
    assert {"upperarm01.L", "lowerarm01.R", "upperleg01.L", "lowerleg01.R", "head", "foot.L", "wrist.L"} <= set(names)
    assert not any(name.startswith(("finger", "toe", "eye", "jaw")) for name in names)


def test_no_correction_changes_nothing():
    corrections, pose, cameras = _corrections(), axis_angle_to_matrix(raised(0.3))[None], around(1)
    assert torch.equal(corrections.rotations(ROW, pose), pose)
    assert torch.equal(corrections.viewmats(ROW, cameras.viewmats), cameras.viewmats)
    gain, bias = corrections.tones(ROW)
    assert torch.equal(gain, torch.ones(1, 3)) and torch.equal(bias, torch.zeros(1, 3))


def test_corrections_never_leave_their_bounds_and_stay_differentiable_there():
    corrections, pose, cameras = _corrections(), axis_angle_to_matrix(raised(0.3))[None], around(1)
    for parameter in corrections.parameters():
        parameter.data.fill_(1e6)
    turned = so3_log(pose.transpose(-1, -2) @ corrections.rotations(ROW, pose)).abs()
    assert float(turned.detach().max()) <= BOUNDS.pose * (1 + 1e-3)
    moved = corrections.viewmats(ROW, cameras.viewmats) @ torch.linalg.inv(cameras.viewmats)
    assert float(moved.detach()[:, :3, 3].abs().max()) <= BOUNDS.shift * (1 + 1e-3)
    gain, bias = corrections.tones(ROW)
    assert torch.isfinite(gain).all() and float(bias.detach().abs().max()) <= BOUNDS.bias * (1 + 1e-3)
    (turned.sum() + moved.sum() + gain.sum() + bias.sum() + corrections.prior(ROW, FullWeights())).backward()
    assert all(torch.isfinite(p.grad).all() for p in corrections.parameters() if p.grad is not None)


def test_a_registered_frame_pays_for_its_corrections_by_what_is_expected_of_it():
    corrections = Corrections(torch.tensor([False, True]), corrected_joints(body()), BOUNDS)
    for parameter in corrections.parameters():
        parameter.data.fill_(0.1)
    found, registered = (float(corrections.prior(torch.tensor([row]), FullWeights()).detach()) for row in (0, 1))
    ratio = (BOUNDS.expected / BOUNDS.registered) ** 2
    assert abs(registered / found - ratio) < 1e-4 * ratio and ratio > 10
    both = float(corrections.prior(torch.tensor([0, 1]), FullWeights()).detach())
    assert abs(both - (found + registered) / 2) < 1e-5 * both


def test_turning_root_and_camera_against_each_other_leaves_the_picture():
    """The gauge: the root turned about a camera's axis through it, and the camera turned back."""
    cameras, pose = around(1), raised(0.3)
    plain = seen(pose, cameras).images
    omega = torch.tensor([0.03, -0.02, 0.04])
    turned = pose.clone()
    turned[0] = so3_log(axis_angle_to_matrix(pose[:1])[0] @ so3_exp(omega))
    # The root turns about its rest place; the camera that undoes it turns about the same point.
    place, turn = kinematics().rest_joints[0, 0], torch.eye(4)
    turn[:3, :3] = axis_angle_to_matrix(pose[:1])[0] @ so3_exp(omega) @ axis_angle_to_matrix(pose[:1])[0].T
    turn[:3, 3] = place - turn[:3, :3] @ place
    back = cameras.viewmats @ torch.linalg.inv(turn)
    shifted = seen(turned, type(cameras)(back, cameras.Ks, cameras.width, cameras.height)).images
    # Round-off swaps a few coplanar Gaussians, and takes a few across the rasterizer's alpha cutoff.
    difference = (shifted - plain).abs()
    assert float(difference.mean()) < 2e-4 and float((difference > 0.02).float().mean()) < 2e-3
    assert float((seen(turned, cameras).images - plain).abs().max()) > 0.05


def test_the_gauge_does_not_drift_and_a_shift_along_it_decays():
    """Along the gauge only the priors act; from opposite shifts both go back to zero and stay."""
    corrections = _corrections()
    with torch.no_grad():
        corrections.pose[0, 0, 2] = 0.3
        corrections.camera[0, 1] = -0.3
    optimizer = torch.optim.Adam(corrections.parameters(), lr=2e-2)
    largest = []
    for _ in range(150):
        optimizer.zero_grad()
        corrections.prior(ROW, FullWeights()).backward()
        optimizer.step()
        largest.append(max(corrections.largest().values()))
    assert max(largest) <= 0.3
    assert largest[-1] < 0.03
    assert max(largest[-20:]) < 0.05
