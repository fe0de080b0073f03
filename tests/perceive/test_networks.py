"""The landmark networks: three sizes that answer alike, and what two of them say together."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import cv2
import numpy as np
import pytest

from ahoy_core.perceive.networks import FULL, Landmarker, Networks, RawLandmarks, _mean, files_of
from tasks.model_files import ModelFileError
from tasks.roles import landmark_networks

CROP = 256


def _load(landmarker: Landmarker) -> Networks:
    try:
        return landmark_networks(landmarker)
    except ModelFileError as error:
        pytest.skip(str(error))


def _answer(value: float) -> RawLandmarks:
    points = np.full((39, 3), value, np.float32)
    share = np.full(39, value, np.float32)
    mask, heat = np.full((CROP, CROP), value, np.float32), np.full((64, 64, 39), value, np.float32)
    return RawLandmarks(points, share, share, points, value, mask, heat)


def test_two_networks_answer_with_their_mean_and_the_first_ones_mask() -> None:
    both = _mean([_answer(0.2), _answer(0.6)])
    for name in ("points", "visibility", "presence", "world", "heatmap"):
        assert getattr(both, name) == pytest.approx(0.4) and getattr(both, name).dtype == np.float32
    assert both.score == pytest.approx(0.4) and (both.mask == np.float32(0.2)).all()
    alone = _answer(0.3)
    assert _mean([alone]) is alone


def test_a_missing_file_is_named() -> None:
    with pytest.raises(ValueError, match="pose_landmark_heavy, face_landmark, got none for pose_landmark_heavy"):
        Networks(dict.fromkeys(files_of(FULL), Path("x")), landmarker="pose_landmark_full+pose_landmark_heavy")


@pytest.mark.parametrize("landmarker", [each for each in get_args(Landmarker) if each != FULL])
def test_every_size_sees_the_same_person_where_the_full_network_does(landmarker: Landmarker) -> None:
    """A drawn figure: heads and limbs are where they are, whatever the size."""
    picture = _figure()
    reference, other = _load(FULL).landmarks(picture), _load(landmarker).landmarks(picture)
    assert reference.score > 0.5 and other.score > 0.5
    shoulders_hips = [11, 12, 23, 24]
    off = np.linalg.norm((reference.points - other.points)[shoulders_hips, :2], axis=1)
    assert off.max() < 0.08 * CROP
    assert other.mask.shape == reference.mask.shape and other.heatmap.shape == reference.heatmap.shape


def _figure() -> np.ndarray:
    """A person of plain shapes over a wall, [256,256,3] in [0,1]."""
    picture = np.full((CROP, CROP, 3), 200, np.uint8)
    skin, shirt, jeans = (205, 150, 120), (170, 50, 50), (40, 60, 120)
    cv2.ellipse(picture, (128, 50), (15, 19), 0, 0, 360, skin, -1, cv2.LINE_AA)
    cv2.ellipse(picture, (128, 38), (16, 11), 0, 0, 360, (50, 35, 25), -1, cv2.LINE_AA)
    cv2.fillPoly(picture, [np.array([[100, 76], [156, 76], [148, 140], [108, 140]])], shirt, cv2.LINE_AA)
    for side in (-1, 1):
        cv2.line(picture, (128 + side * 26, 82), (128 + side * 36, 118), shirt, 13, cv2.LINE_AA)
        cv2.line(picture, (128 + side * 36, 118), (128 + side * 38, 150), skin, 10, cv2.LINE_AA)
        cv2.line(picture, (128 + side * 11, 140), (128 + side * 13, 190), jeans, 19, cv2.LINE_AA)
        cv2.line(picture, (128 + side * 13, 190), (128 + side * 14, 234), jeans, 15, cv2.LINE_AA)
    return cv2.GaussianBlur(picture, (3, 3), 0).astype(np.float32) / 255
