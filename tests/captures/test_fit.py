"""A capture as the stages take it: clip, masks and the true fit, on a small capture made here."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from ahoy_core.body.convert import to_local_ref
from ahoy_core.body.packaged import load_packaged_body
from ahoy_core.captures import Capture, View, read_dataset
from ahoy_core.captures.fit import posed_vertices, read_clip, true_fit, true_frames, true_rgba
from ahoy_core.formats.video_write import write_mp4

COUNT, HEIGHT, WIDTH = 3, 32, 48
GREEN, RED = (0, 200, 0), (200, 0, 0)
TRANSL = torch.tensor([0.1, -0.2, 0.3])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    body = load_packaged_body()
    home = tmp_path / "c"
    (home / "vis").mkdir(parents=True)
    (home / "gt").mkdir()
    frames = np.full((COUNT, HEIGHT, WIDTH, 3), GREEN, np.uint8)
    write_mp4(home / "front.mp4", frames, fps=15)
    for t in range(COUNT):
        cv2.imwrite(str(home / "vis" / f"{t:03d}.png"), np.full((HEIGHT, WIDTH), 10 * t, np.uint8))
    for t in (0, 2):
        cv2.imwrite(str(home / "gt" / f"front_{t:03d}.png"), np.full((HEIGHT, WIDTH, 4), (*RED[::-1], 99), np.uint8))
    camera = {"K": [[50, 0, 24], [0, 50, 16], [0, 0, 1]], "R": [[1, 0, 0], [0, 0, -1], [0, 1, 0]], "t": [0, 1, 5]}
    cameras = {"cameras": {"front": {**camera, "width": WIDTH, "height": HEIGHT}}}
    (home / "cameras.json").write_text(json.dumps(cameras), encoding="utf-8")
    pose = torch.zeros(COUNT, body.n_joints, 3)
    pose[1, 0, 2] = 0.5
    pose_local_ref = to_local_ref(body, pose, TRANSL.expand(COUNT, 3), body.default_betas)
    phenotype = dict(zip(body.beta_names, body.default_betas.tolist(), strict=True))
    np.savez(home / "motion.npz", pose_local_ref=pose_local_ref.numpy(), phenotype=json.dumps(phenotype))
    return home


@pytest.fixture
def capture(folder: Path) -> Capture:
    return read_dataset(folder)[0]


def test_the_clip_holds_video_masks_and_times(capture: Capture) -> None:
    clip = read_clip(capture)
    assert clip.frames.shape == (COUNT, HEIGHT, WIDTH, 3)
    assert np.abs(clip.frames.mean((0, 1, 2)) - GREEN).max() < 6
    assert [mask.min() for mask in clip.visible] == [0, 10, 20]
    assert clip.times.tolist() == [0, 1 / 15, 2 / 15]
    assert len(clip.first(2).frames) == len(clip.first(2).visible) == len(clip.first(2).times) == 2


def test_true_pictures_are_rgba_in_levels(capture: Capture) -> None:
    assert true_frames(capture) == [0, 2]
    assert true_rgba(capture, View("view", "front", 2))[0, 0].tolist() == [*RED, 99]


def test_the_true_body_stands_where_the_motion_says(capture: Capture) -> None:
    body = load_packaged_body()
    fit = true_fit(capture, body)
    pose = torch.zeros(body.n_joints, 3)
    for frame, angle in ((0, 0.0), (1, 0.5)):
        pose[0, 2] = angle
        expected = body(pose[None], body.default_betas[None], TRANSL[None]).vertices[0]
        assert np.abs(posed_vertices(body, fit, frame) - expected.numpy()).max() < 1e-4


def test_a_missing_mask_is_named(folder: Path) -> None:
    (folder / "vis" / "001.png").unlink()
    with pytest.raises(ValueError, match=r"001\.png"):
        read_clip(read_dataset(folder)[0])


def test_masks_of_another_size_than_the_video_are_refused(folder: Path) -> None:
    for t in range(COUNT):
        cv2.imwrite(str(folder / "vis" / f"{t:03d}.png"), np.zeros((HEIGHT, WIDTH + 2), np.uint8))
    with pytest.raises(ValueError, match="masks"):
        read_clip(read_dataset(folder)[0])
