"""Structured motions: planned from coverage, framed, and synchronised."""

from __future__ import annotations

import math

import pytest
import torch

from ahoy_core.body.lbs import forward_kinematics, lbs
from ahoy_core.body.packaged import PackagedBody, load_packaged_body
from ahoy_core.body.rotations import axis_angle_to_matrix
from ahoy_core.prior.bodymaps import body_maps, camera_azimuth
from ahoy_core.prior.sequences import ACTIONS, plan_motions, pose_distance, synchronise


@pytest.fixture(scope="module")
def body() -> PackagedBody:
    return load_packaged_body()


def front_seen(body: PackagedBody) -> torch.Tensor:
    """A video that showed all that faces the camera (-y)."""
    vertices = body.shape(body.default_betas[None])[0][0]
    a, b, c = vertices[body.faces].unbind(1)
    return (torch.linalg.cross(b - a, c - a)[:, 1] < 0).float()


def test_everything_seen_needs_nothing_and_every_refusal_has_a_reason(body: PackagedBody) -> None:
    plan = plan_motions(body, body.default_betas, torch.ones(len(body.faces)), frames=2)
    assert plan.sequences == () and set(plan.dropped) == set(ACTIONS)
    assert all("unseen: less than 2%" in reason for reason in plan.dropped.values())


def test_a_back_that_was_never_seen_is_planned_with_turns(body: PackagedBody) -> None:
    plan = plan_motions(body, body.default_betas, front_seen(body), frames=4, limit=2)
    assert len(plan.sequences) == 2 and len(plan.dropped) == len(ACTIONS) - 2
    assert plan.sequences[0].unseen >= plan.sequences[1].unseen > 0.2
    for sequence in plan.sequences:
        assert f"{sequence.unseen:.1%}" in sequence.reason
        assert sequence.pose.shape == (4, body.n_joints, 3) and len(sequence.cameras) == 4


def test_a_turn_and_a_camera_going_round_show_the_same_side(body: PackagedBody) -> None:
    plan = plan_motions(body, body.default_betas, torch.zeros(len(body.faces)), frames=4, limit=len(ACTIONS))
    for sequence in plan.sequences:
        rotations = axis_angle_to_matrix(sequence.pose)
        azimuths = camera_azimuth(sequence.cameras.viewmats, rotations[:, 0])
        expected = torch.arange(4) * math.pi / 2
        away = (azimuths - expected + math.pi) % (2 * math.pi) - math.pi
        assert float(away.abs().max()) < 0.1, sequence.name  # cameras aim at the box's middle, not at the root


def test_sequences_are_framed_as_person_images(body: PackagedBody) -> None:
    plan = plan_motions(body, body.default_betas, torch.zeros(len(body.faces)), frames=4, limit=len(ACTIONS))
    rest, joints = body.shape(body.default_betas[None])
    for sequence in plan.sequences:
        rotations = axis_angle_to_matrix(sequence.pose)
        transforms = forward_kinematics(rotations, joints, body.parents, sequence.transl)
        pixels = sequence.cameras.project(lbs(rest[0], body.lbs_weights, transforms)).pixels
        size = torch.tensor([sequence.cameras.width, sequence.cameras.height])
        extent = (pixels.amax((0, 1)) - pixels.amin((0, 1))) / size
        # A sparse set of vertices gives the box, so a pixel may be missing.
        assert float(extent.max()) == pytest.approx(0.9, abs=0.02), sequence.name
        assert float((0.5 * (pixels.amax((0, 1)) + pixels.amin((0, 1))) / size - 0.5).abs().max()) < 0.02


def test_coverage_of_another_body_is_refused(body: PackagedBody) -> None:
    with pytest.raises(ValueError, match="one a triangle"):
        plan_motions(body, body.default_betas, torch.zeros(5))


def turned(degrees: list[float]) -> torch.Tensor:
    omega = torch.zeros(len(degrees), 2, 3)
    omega[:, 0, 2] = torch.deg2rad(torch.tensor(degrees))
    return axis_angle_to_matrix(omega)


def test_frames_of_equal_pose_are_matched_and_the_rest_is_counted() -> None:
    videos = [turned([0, 10, 20, 80]), turned([21, 1, 50]), turned([0, 11, 19])]
    groups, alone = synchronise(videos, tolerance=math.radians(3))
    assert groups == [(0, 1, 0), (2, 0, 2)] and alone == [2, 1, 1]


def test_a_frame_is_used_once() -> None:
    groups, alone = synchronise([turned([0, 0.5]), turned([0])], tolerance=math.radians(3))
    assert groups == [(0, 0)] and alone == [1, 0]


def test_pose_distance_is_an_angle() -> None:
    distance = pose_distance(turned([0])[0], turned([0, 90, 180]))
    expected = torch.tensor([0, math.pi / 2, math.pi]) / math.sqrt(2)  # one of two joints turns
    torch.testing.assert_close(distance, expected, rtol=0, atol=1e-3)


def test_body_maps_tell_front_from_back_and_left_from_right(body: PackagedBody) -> None:
    plan = plan_motions(body, body.default_betas, torch.zeros(len(body.faces)), frames=4, limit=1)
    sequence = plan.sequences[0]
    rest, joints = body.shape(body.default_betas[None])
    transforms = forward_kinematics(axis_angle_to_matrix(sequence.pose), joints, body.parents, sequence.transl)
    maps = body_maps(body, lbs(rest[0], body.lbs_weights, transforms), sequence.cameras)
    assert maps.shape == (4, 7, 32, 16) and float(maps.abs().max()) <= 1 + 1e-6
    inside = maps[:, 0] > 0.99
    front, left, back = (maps[k][:, inside[k]] for k in (0, 1, 2))
    assert float(front[2].mean()) < float(back[2].mean()) - 0.2  # y: the front of the body has the smaller one
    assert float(left[1].mean()) > 0.02  # x: what one sees of the left side lies towards +x
    assert float(front[6].mean()) < -0.5  # normals face the camera
    # In front of the camera the person's left (+x) is on the right of the picture.
    columns = torch.arange(16.0).expand(32, 16)[inside[0]]
    assert float(torch.corrcoef(torch.stack([columns, front[1]]))[0, 1]) > 0.9
    with pytest.raises(ValueError, match="one camera a frame"):
        body_maps(body, rest, sequence.cameras)
