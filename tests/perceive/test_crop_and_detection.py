"""Squares and boxes: what goes into the networks must come back to the same pixel."""

from __future__ import annotations

import numpy as np
import pytest

from ahoy_core.perceive.crop import Roi, paste, roi_from_points, sample
from ahoy_core.perceive.detection import Detection, anchors, box_iou, decode, merge

TILTED = Roi(120.3, 80.7, 90.0, 0.7)


def test_crop_coordinates_come_back_to_the_same_pixel() -> None:
    points = np.random.default_rng(0).uniform(-50, 200, (40, 2))
    np.testing.assert_allclose(TILTED.to_image(TILTED.to_crop(points)), points, atol=1e-9)
    np.testing.assert_allclose(TILTED.to_image(np.array([0.5, 0.5])), [120.3, 80.7], atol=1e-9)


@pytest.mark.parametrize("roi", [TILTED, Roi(128.0, 100.0, 64.0, 0.0), Roi(128.0, 100.0, 200.0, -2.0)])
def test_a_spot_in_the_picture_appears_in_the_crop_where_the_coordinates_say(roi: Roi) -> None:
    spot = roi.to_image(np.array([0.4, 0.7]))
    rows, columns = np.mgrid[:200, :256] + 0.5
    blob = np.exp(-((columns - spot[0]) ** 2 + (rows - spot[1]) ** 2) / (2 * 4.0**2))
    crop = sample(np.repeat((blob * 255).astype(np.uint8)[..., None], 3, axis=2), roi, 128)[..., 0]
    v, u = (np.mgrid[:128, :128] + 0.5) / 128
    centre = np.array([(crop * u).sum(), (crop * v).sum()]) / crop.sum()
    # An eighth of an image pixel: half a pixel of misplaced pixel centres would show.
    np.testing.assert_allclose((centre - [0.4, 0.7]) * roi.size, 0, atol=0.125)


def test_a_mask_pasted_into_the_picture_lies_where_it_was_cropped() -> None:
    v, u = (np.mgrid[:64, :64] + 0.5) / 64
    blob = np.exp(-((u - 0.4) ** 2 + (v - 0.6) ** 2) / (2 * 0.08**2))
    image = paste(blob, TILTED, 200, 256)
    rows, columns = np.mgrid[:200, :256] + 0.5
    centre = np.array([(image * columns).sum(), (image * rows).sum()]) / image.sum()
    np.testing.assert_allclose(centre, TILTED.to_image(np.array([0.4, 0.6])), atol=0.125)


def test_an_upright_person_gets_an_upright_square_and_a_fallen_one_a_turned_square() -> None:
    upright = roi_from_points(np.array([50.0, 60.0]), np.array([50.0, 20.0]))
    assert (upright.cx, upright.cy, upright.size, upright.angle) == pytest.approx((50.0, 60.0, 100.0, 0.0))
    fallen = roi_from_points(np.array([50.0, 60.0]), np.array([90.0, 60.0]))
    assert fallen.angle == pytest.approx(np.pi / 2)
    # "Up" in the crop is where the head is.
    np.testing.assert_allclose(fallen.to_image(np.array([0.5, 0.1])), [90.0, 60.0], atol=1e-9)


def test_the_detector_has_its_2254_anchors_in_rows_of_cells() -> None:
    assert anchors().shape == (2254, 2)
    np.testing.assert_allclose(anchors()[0], anchors()[1])
    np.testing.assert_allclose(anchors()[2] - anchors()[0], [1 / 28, 0])
    np.testing.assert_allclose(anchors()[1568], [0.5 / 14, 0.5 / 14])
    np.testing.assert_allclose(anchors()[-1], [6.5 / 7, 6.5 / 7])


def test_a_box_written_at_one_anchor_is_decoded_and_the_others_are_not() -> None:
    regressions, logits = np.zeros((2254, 12), np.float32), np.full(2254, -200.0, np.float32)
    cx, cy = anchors()[700]
    regressions[700] = [11.2, -22.4, 44.8, 67.2, 0, 0, 0, -56, 1, 2, 3, 4]
    logits[700] = 3.0
    (found,) = decode(regressions, logits)
    np.testing.assert_allclose(found.box, [cx - 0.05, cy - 0.25, cx + 0.15, cy + 0.05], atol=1e-6)
    np.testing.assert_allclose(found.keypoints[1], [cx, cy - 0.25], atol=1e-6)
    assert found.score == pytest.approx(1 / (1 + np.exp(-3)))


def test_overlapping_boxes_become_one_and_separate_people_stay_two() -> None:
    def at(x: float, score: float) -> Detection:
        return Detection(np.array([x, 0.0, x + 1, 1.0]), np.full((4, 2), x), score)

    merged = merge([at(0.0, 0.9), at(0.2, 0.6), at(5.0, 0.7)])
    assert [round(float(d.box[0]), 3) for d in merged] == [0.08, 5.0]
    assert [d.score for d in merged] == [0.9, 0.7]


def test_iou_of_empty_boxes_is_zero_and_of_equal_ones_is_one() -> None:
    box = np.array([1.0, 1.0, 3.0, 4.0])
    assert box_iou(box, box) == 1.0
    assert box_iou(np.zeros(4), np.zeros(4)) == 0.0
