from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ahoy_core.animate import FOV, evenly_chosen, framing_cameras, motion_frames, render_views, turntable
from ahoy_core.avatar import Avatar, AvatarInfo
from ahoy_core.avatar.avatar import bake, network_config
from ahoy_core.avatar.deform import OffsetBounds, offset_channels
from ahoy_core.body.canonical import canonical_pose
from ahoy_core.maps import StyleUNet
from ahoy_core.motion import Motion, replay, turn
from tests.avatar.scenes import body, dressed

SIZE = 48


@cache
def _avatar(map_size: int = 64) -> Avatar:
    start = dressed(map_size)
    network = StyleUNet(network_config(start, 4, offset_channels(start)), torch.Generator().manual_seed(0))
    poses = canonical_pose(body())[None]
    return bake(start, network, OffsetBounds(), body().default_betas, poses, AvatarInfo(body=body().name))


def _person(frames: np.ndarray) -> np.ndarray:
    """Pixels that are not the grey background."""
    return (np.abs(frames.astype(int) - 128) > 6).any(-1)


def test_the_turntable_shows_the_whole_person_from_every_side():
    frames = turntable(_avatar(), body(), 6, SIZE, SIZE)
    assert frames.shape == (6, SIZE, SIZE, 3) and frames.dtype == np.uint8
    for person in _person(frames):
        rows = np.flatnonzero(person.any(1))
        assert 0.6 * SIZE < rows[-1] - rows[0] < SIZE - 1
        assert not person[:, [0, -1]].any()


@pytest.mark.parametrize(("height", "width"), [(160, 120), (120, 160), (240, 80)])
def test_the_person_fills_the_picture_in_the_direction_that_binds(height: int, width: int):
    people = _person(turntable(_avatar(128), body(), 8, height, width))
    tall, wide = people.any(2).sum(1).max() / height, people.any(1).sum(1).max() / width
    assert 0.8 <= max(tall, wide) <= 0.97
    assert min(tall, wide) <= 0.97


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), n=st.integers(1, 9), stretch=st.floats(0.05, 20.0), height=st.integers(16, 400))
def test_every_point_is_within_the_frame_and_one_is_at_its_border(seed: int, n: int, stretch: float, height: int):
    points = torch.rand(50, 3, generator=torch.Generator().manual_seed(seed)) * torch.tensor([1.0, 1.0, stretch]) + 3
    width = 200
    cameras = framing_cameras(points, n, height, width)
    seen = points @ cameras.viewmats[:, :3, :3].transpose(1, 2) + cameras.viewmats[:, None, :3, 3]
    focal = height / (2 * math.tan(FOV / 2))
    across, along = (seen[..., i].abs() / seen[..., 2] * focal for i in (0, 1))
    share = torch.maximum(across / (width / 2), along / (height / 2))
    assert (seen[..., 2] > 0).all()
    assert float(share.max()) <= 0.9 + 1e-4
    # Unless the picture is so wide that the camera would have to stand among the points.
    middle, span = (points.amax(0) + points.amin(0)) / 2, (points.amax(0) - points.amin(0)).norm()
    radius = float((cameras.viewmats[0, :3, :3] @ middle + cameras.viewmats[0, :3, 3])[2])
    assert float(share.max()) >= 0.9 - 1e-3 or math.isclose(radius, float(span), rel_tol=1e-3)


def test_front_and_back_have_one_outline_mirrored():
    frames = turntable(_avatar(), body(), 2, SIZE, SIZE)
    front, back = _person(frames)
    mirrored = back[:, ::-1]
    assert (front & mirrored).sum() / (front | mirrored).sum() > 0.85


def test_turning_the_person_or_the_camera_shows_the_same():
    """A body that turns left by a quarter shows what a camera sees a quarter round to its right, and the reverse."""
    avatar = _avatar()
    still = avatar.pose(body(), canonical_pose(body()))
    cameras = framing_cameras(still.means, 4, SIZE, SIZE)
    turned = turn(body(), 4, 15.0)
    center = body()(canonical_pose(body())[None], body().default_betas[None], torch.zeros(1, 3)).joints[0, 0]
    # Cameras go round the middle of the box, the person turns about the pelvis: shift the one onto the other.
    middle = (still.means.amin(0) + still.means.amax(0)) / 2
    shift = (middle - center) * torch.tensor([1.0, 1.0, 0.0])
    around = render_views(avatar.pose(body(), canonical_pose(body()), shift), cameras)
    spun = np.concatenate([render_views(avatar.pose(body(), pose, shift), cameras[0]) for pose in turned.pose])
    for number in range(4):
        assert np.abs(spun[number].astype(int) - around[-number % 4].astype(int)).mean() < 1.0
    assert np.abs(spun[1].astype(int) - around[1].astype(int)).mean() > 1.0


def test_a_motion_stays_in_the_picture():
    pose = canonical_pose(body()).expand(9, -1, -1)
    transl = torch.stack([torch.linspace(-1, 1, 9), torch.zeros(9), torch.zeros(9)], 1)
    frames = np.stack(list(motion_frames(_avatar(), body(), replay(pose, transl, 15.0), SIZE, SIZE)))
    persons = _person(frames)
    assert frames.shape == (9, SIZE, SIZE, 3)
    assert persons.any((1, 2)).all()
    assert not persons[:, :, [0, -1]].any()
    middles = [np.flatnonzero(person.any(0)).mean() for person in persons]
    assert middles == sorted(middles)


def test_motion_progress_counts_frames():
    seen: list[tuple[int, int]] = []
    motion = Motion("still", canonical_pose(body()).expand(2, -1, -1), torch.zeros(2, 3), 15.0)
    list(motion_frames(_avatar(), body(), motion, SIZE, SIZE, lambda done, total: seen.append((done, total))))
    assert seen == [(1, 2), (2, 2)]


def test_frames_for_a_sheet_are_evenly_chosen_and_a_short_clip_repeats_some():
    frames = np.arange(16, dtype=np.uint8)[:, None, None, None] * np.ones((1, 2, 3, 3), dtype=np.uint8)
    assert [int(frame[0, 0, 0]) for frame in evenly_chosen(frames)] == [0, 2, 4, 6, 8, 10, 12, 14]
    assert [int(frame[0, 0, 0]) for frame in evenly_chosen(frames[:3], 6)] == [0, 0, 1, 1, 2, 2]
    with pytest.raises(ValueError, match="at least one frame"):
        evenly_chosen(frames[:0])
