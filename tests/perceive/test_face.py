"""Expressions: geometry, the packaged map, and rendered faces whose actions are known."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

import cv2
import numpy as np
import pytest

from ahoy_core.body.packaged import PackagedBody
from ahoy_core.perceive.crop import Roi
from ahoy_core.perceive.face import (
    ASSET,
    FaceReading,
    expressions,
    first_crop,
    load_face_map,
    on_reference,
    read_face,
    second_crop,
)
from ahoy_core.perceive.networks import Networks

FACES = Path(__file__).parent / "faces.npz"  # python -m benchmarks.train_face golden tests/perceive/faces.npz
ACTIONS = 52


def placed(angle: float = 0.0, scale: float = 40.0, shift: tuple[float, float] = (100.0, 80.0)) -> np.ndarray:
    """The reference face in an image, turned about the vertical."""
    c, s = np.cos(angle), np.sin(angle)
    turned = load_face_map().reference.astype(np.float64) @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])
    return scale * turned + [*shift, 0.0]


def reading(points: np.ndarray, size: float = 120.0, score: float = 1.0) -> FaceReading:
    return FaceReading(points, score, Roi(100, 80, size, 0))


def test_a_face_laid_on_the_reference_does_not_depend_on_place_size_and_turn() -> None:
    known = load_face_map()
    for angle, scale in ((0.0, 40.0), (0.4, 15.0), (-0.7, 90.0)):
        back, turned = on_reference(placed(angle, scale), known.reference)
        np.testing.assert_allclose(back, known.reference, atol=1e-5)
        assert turned == pytest.approx(abs(angle), abs=1e-5)


def test_a_resting_face_is_neutral_and_sure_one_turned_away_or_tiny_is_neither() -> None:
    expression, confidence = expressions(
        [reading(placed()), reading(placed(1.5)), reading(placed(), size=20.0), None], ACTIONS
    )
    assert float(expression.max()) < 0.05
    assert confidence[0] > 0.9 and not confidence[1:].any()
    assert not expression[1:].any()


def test_a_mouth_that_opens_in_the_middle_of_a_clip_opens_the_jaw(body: PackagedBody) -> None:
    known = load_face_map()
    jaw = body.expression_names.index("jawOpen")
    clip = []
    for t in range(12):
        points = known.reference.astype(np.float64).copy()
        open_by = 0.25 * max(0.0, np.sin(t / 11 * np.pi))
        points[[14, 17, 152], 1] += open_by
        clip.append(reading(40 * points + [100, 80, 0]))
    expression, _ = expressions(clip, ACTIONS)
    assert expression[6, jaw] > expression[0, jaw] + 0.15
    assert expression.min() >= 0 and expression.max() <= 1


def test_a_body_of_other_actions_gets_neutral_faces() -> None:
    expression, confidence = expressions([reading(placed())], 10)
    assert expression.shape == (1, 10) and not expression.any() and not confidence.any()


def test_crops_of_degenerate_landmarks_are_none_or_finite() -> None:
    assert first_crop(np.zeros((33, 2))) is None
    assert first_crop(np.full((33, 2), np.nan)) is None
    assert second_crop(np.zeros((468, 3))).size == 1.0


def test_the_asset_is_small() -> None:
    assert resources.files("ahoy_core.assets").joinpath(ASSET).stat().st_size < 1e5  # type: ignore[attr-defined]


def test_rendered_faces_are_read(body: PackagedBody, networks: Networks) -> None:
    """Heads of two people that the map was not learned on; the actions that the map claims to read follow the truth."""
    data = np.load(FACES)
    ends = np.cumsum(data["sizes"])
    found, truth = [], []
    for i, end in enumerate(ends):
        image = cv2.imdecode(data["jpeg"][end - data["sizes"][i] : end], cv2.IMREAD_COLOR)[..., ::-1]
        found.append(read_face(networks, np.ascontiguousarray(image), data["landmarks"][i]))
        truth.append(data["actions"][i])
    assert sum(f is not None for f in found) >= 0.9 * len(found)
    expression, confidence = expressions(found, ACTIONS)
    sure = confidence > 0
    jaw = body.expression_names.index("jawOpen")
    # .7 and more over people left out of the training; few faces here.
    assert np.corrcoef(expression[sure, jaw], np.stack(truth)[sure, jaw])[0, 1] > 0.5
