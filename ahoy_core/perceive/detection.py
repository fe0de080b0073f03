"""People in one frame: the detector's anchors, the decoding of its boxes, and what is kept of them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from ahoy_core.perceive.crop import Roi, roi_from_points
from ahoy_core.perceive.networks import DETECTOR_SIZE, Networks, sigmoid

# (cells a side, anchors a cell): strides 8 and 16 with two anchors a cell, three layers of stride 32 with two each.
ANCHOR_GRIDS = ((28, 2), (14, 2), (7, 6))
N_KEYPOINTS = 4  # hips' centre, circle round the body, shoulders' centre, circle round the upper body
MIN_SCORE = 0.5
NMS_IOU = 0.3
SCORE_CLIP = 100.0  # logits beyond this say the same


@dataclass(frozen=True)
class Detection:
    """One person: head box [4] (x0, y0, x1, y1) and alignment points [4,2], both in image pixels, and score."""

    box: NDArray[np.float64]
    keypoints: NDArray[np.float64]
    score: float

    @property
    def roi(self) -> Roi:
        """Crop of the whole body."""
        return roi_from_points(self.keypoints[0], self.keypoints[1])


@cache
def anchors() -> NDArray[np.float32]:
    """Return the anchors' centres [2254,2] (x, y) in [0,1], in the order of the detector's output."""
    grids = []
    for cells, repeats in ANCHOR_GRIDS:
        centre = (np.arange(cells, dtype=np.float32) + 0.5) / cells
        x, y = np.meshgrid(centre, centre)
        grids.append(np.repeat(np.stack([x.ravel(), y.ravel()], axis=1), repeats, axis=0))
    return np.concatenate(grids)


def decode(
    regressions: NDArray[np.float32], logits: NDArray[np.float32], min_score: float = MIN_SCORE
) -> list[Detection]:
    """Decode raw detector output, in units of the detector's square input ([0,1]).

    Args:
        regressions: [2254,12] centre, size and four points in input pixels, relative to the anchor's centre.
        logits: [2254].
        min_score: boxes below are dropped.
    """
    scores = sigmoid(np.clip(logits, -SCORE_CLIP, SCORE_CLIP))
    kept = scores >= min_score
    values = (regressions[kept] / DETECTOR_SIZE).astype(np.float64)
    centres = anchors()[kept]
    middle, size = values[:, :2] + centres, values[:, 2:4]
    boxes = np.concatenate([middle - size / 2, middle + size / 2], axis=1)
    points = values[:, 4:].reshape(-1, N_KEYPOINTS, 2) + centres[:, None]
    return [Detection(b, k, float(s)) for b, k, s in zip(boxes, points, scores[kept], strict=True)]


def merge(detections: list[Detection], iou: float = NMS_IOU) -> list[Detection]:
    """Blend overlapping boxes, weighted by score (weighted non-maximum suppression of BlazeFace); best first."""
    rest = sorted(detections, key=lambda d: -d.score)
    merged = []
    while rest:
        best = rest[0]
        group = [d for d in rest if d is best or box_iou(d.box, best.box) > iou]
        rest = [d for d in rest if not any(d is g for g in group)]
        weights = np.array([d.score for d in group])
        weights /= weights.sum()
        box = np.einsum("n,nk->k", weights, np.stack([d.box for d in group]))
        points = np.einsum("n,nkc->kc", weights, np.stack([d.keypoints for d in group]))
        merged.append(Detection(box, points, best.score))
    return merged


def detect(networks: Networks, frame: NDArray[np.uint8], min_score: float = MIN_SCORE) -> list[Detection]:
    """Find people in one frame [H,W,3], best first, in image pixels."""
    height, width = frame.shape[:2]
    side = max(height, width)
    scale = DETECTOR_SIZE / side
    # Rounded to whole pixels here, undone with the exact ratios below.
    small_w, small_h = max(1, round(width * scale)), max(1, round(height * scale))
    small = cv2.resize(frame, (small_w, small_h), interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC)
    x0, y0 = (DETECTOR_SIZE - small_w) // 2, (DETECTOR_SIZE - small_h) // 2
    canvas = np.zeros((DETECTOR_SIZE, DETECTOR_SIZE, 3), np.float32)
    canvas[y0 : y0 + small_h, x0 : x0 + small_w] = small.astype(np.float32) / 255.0
    offset = np.array([x0, y0]) / DETECTOR_SIZE
    ratio = DETECTOR_SIZE * np.array([width / small_w, height / small_h])
    found = merge(decode(*networks.detect(canvas), min_score))
    return [
        Detection((d.box.reshape(2, 2) - offset).ravel() * np.tile(ratio, 2), (d.keypoints - offset) * ratio, d.score)
        for d in found
    ]


def box_iou(a: NDArray[np.floating], b: NDArray[np.floating]) -> float:
    """Intersection over union of two boxes (x0, y0, x1, y1); 0 if either is empty."""
    overlap = np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2])
    shared = float(np.prod(np.maximum(overlap, 0.0)))
    union = float(np.prod(np.maximum(a[2:] - a[:2], 0)) + np.prod(np.maximum(b[2:] - b[:2], 0))) - shared
    return shared / union if union > 0 else 0.0
