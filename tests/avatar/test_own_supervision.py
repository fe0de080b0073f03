"""Supervision that the avatar makes for itself where there is no prior: coarse renders, faces out of the video."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import torch

from ahoy_core.avatar import Avatar, AvatarInfo
from ahoy_core.avatar.avatar import bake, network_config
from ahoy_core.avatar.coarse_renders import coarse_sequences
from ahoy_core.avatar.deform import OffsetBounds, offset_channels
from ahoy_core.avatar.face_views import observed_faces
from ahoy_core.avatar.full_config import FullWeights
from ahoy_core.avatar.hallucinated import sequence_shots
from ahoy_core.avatar.render import render
from ahoy_core.maps import StyleUNet
from tests.avatar.full_scenes import kinematics, raised
from tests.avatar.scenes import body, coarse_inputs, dressed, template, with_frames


@cache
def _avatar(observed: float) -> Avatar:
    start = dressed()
    start = start.paint(start.colors, torch.full((len(start),), observed))
    network = StyleUNet(network_config(start, 8, offset_channels(start)), torch.Generator().manual_seed(0))
    return bake(start, network, OffsetBounds(), body().default_betas, raised(0.0)[None], AvatarInfo(body=body().name))


def test_coarse_renders_are_what_the_avatar_looks_like_in_the_pose_that_is_stored_with_them():
    (sequence,) = coarse_sequences(_avatar(0.5), body(), raised(0.4)[None], views=3, height=48, width=40)
    assert sequence.kind == "turn" and len(sequence) == 3
    for index in range(3):
        posed = _avatar(0.5).pose(body(), sequence.pose[index], sequence.transl[index])
        again = render(posed.means, posed.covars, posed.opacities, posed.colors, sequence.cameras[index])
        assert torch.allclose(again.images[0].clamp(0, 1), sequence.frames[index], atol=1e-5)
    assert torch.equal(sequence.map_pose, sequence.pose[0]) and float(sequence.map_pose[0].abs().max()) == 0


def test_the_whole_person_is_in_every_coarse_render():
    (sequence,) = coarse_sequences(_avatar(1.0), body(), raised(1.2)[None], views=4, height=48, width=48)
    assert sequence.alphas is not None
    rim = torch.ones(48, 48, dtype=torch.bool)
    rim[1:-1, 1:-1] = False
    assert float(sequence.alphas[:, rim].max()) < 0.05
    assert float(sequence.alphas.amax((1, 2)).min()) > 0.9


def test_coarse_renders_hold_the_head_which_nothing_else_shows_from_behind():
    (sequence,) = coarse_sequences(_avatar(0.0), body(), raised(0.0)[None], views=2, height=48, width=40)
    weights = FullWeights()
    shots, without = (
        sequence_shots([one], kinematics(), template(), weights, head_split=True)[0][0]
        for one in (sequence, replace(sequence, keeps_head=False))
    )
    assert all(float(a.weight.sum()) > float(b.weight.sum()) for a, b in zip(shots, without, strict=True))


def test_coverage_of_coarse_renders_is_the_observed_share_of_the_surface():
    for observed in (0.0, 0.5, 1.0):
        (sequence,) = coarse_sequences(_avatar(observed), body(), raised(0.0)[None], views=2, height=48, width=40)
        assert sequence.alphas is not None
        solid = sequence.alphas > 0.99
        assert torch.allclose(sequence.coverage[solid], torch.tensor(observed), atol=0.02)


def test_frames_that_show_the_face_are_face_views_before_their_own_camera():
    inputs = coarse_inputs(count=3, size=96)
    faces, reason = observed_faces(inputs, template(), kinematics())
    assert faces is not None and reason == ""
    assert len(faces) == 3
    # The dressed template, of which the frames were made, before the face views' cameras: the same picture.
    truth = dressed()
    from ahoy_core.avatar.deform import deform, dense_weights
    from tests.avatar.scenes import canonical_covars

    weights = dense_weights(truth.skin_indices, truth.skin_weights, body().n_joints)
    for view in range(3):
        means, covars = deform(truth.means, canonical_covars(truth), weights, faces.relative[view])
        made = render(means, covars, truth.opacities, truth.colors, faces.cameras[view]).images[0]
        error = ((made - faces.images[view]).abs() * faces.weights[view]).sum() / (3 * faces.weights[view].sum())
        assert float(error) < 0.02
        assert float(faces.weights[view].sum()) > 64


def test_a_person_seen_from_behind_has_no_face_views_and_the_reason_is_given():
    inputs = coarse_inputs(count=3, size=96)
    away = inputs.pose.clone()
    away[:, 0, 2] += torch.pi
    faces, reason = observed_faces(with_frames(inputs, pose=away), template(), kinematics())
    assert faces is None and "never seen" in reason


def test_a_hidden_face_and_an_empty_mask_have_no_face_views():
    inputs = coarse_inputs(count=3, size=96)
    masks = inputs.masks.clone()
    rows = torch.nonzero(masks[0].amax(1) > 0.5)[:, 0]
    masks[:, : int(rows[0] + 0.2 * (rows[-1] - rows[0]))] = 0  # a head is an eighth of a body
    for hidden in (masks, torch.zeros_like(masks)):
        assert observed_faces(with_frames(inputs, masks=hidden), template(), kinematics())[0] is None
    broken = with_frames(inputs, pose=torch.full_like(inputs.pose, float("nan")))
    assert observed_faces(broken, template(), kinematics())[0] is None


def test_face_views_carry_the_expression_of_their_frames():
    inputs = coarse_inputs(count=3, size=96)
    expression = torch.arange(3.0)[:, None].expand(3, body().n_expressions)
    faces, _ = observed_faces(inputs, template(), kinematics(), expression)
    assert faces is not None
    assert sorted(faces.expression[:, 0].tolist()) == [0.0, 1.0, 2.0]
    assert replace(faces, expression=faces.expression * 0).expression.abs().max() == 0
