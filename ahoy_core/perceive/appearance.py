"""What a person looks like, coarsely: colours of chest and thighs, to tell people apart when place and size cannot."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from ahoy_core.perceive.detection import Detection

COLOURS = (78, 178)  # of 256, range of the two colour axes that is told apart
BINS = (4, 8, 8)  # of lightness and of the two colour axes: light changes more than colour
HALF_WIDTH = 0.35  # of a patch, in lengths of the torso
CHEST, THIGHS = (0.15, 0.95), (-0.7, -0.1)  # from the hips (0) to the shoulders (1)
SOFTEN = 0.7  # bins: a little more or less light must not make another person
PATCH = 16  # samples a side
HIPS, SHOULDERS = 0, 2  # of a detection's points


def appearance(frame: NDArray[np.uint8], detection: Detection) -> NDArray[np.float32]:
    """Colour statistics [2*256] of a detected person: square roots of two histograms, unit length.

    Args:
        frame: [H,W,3] sRGB.
        detection: of the person, image pixels.
    """
    hips, shoulders = detection.keypoints[HIPS], detection.keypoints[SHOULDERS]
    up = shoulders - hips
    across = HALF_WIDTH * np.array([-up[1], up[0]])
    parts = [_histogram(_patch(frame, hips, up, across, span)) for span in (CHEST, THIGHS)]
    whole = np.concatenate(parts)
    return np.asarray(np.sqrt(whole / max(float(whole.sum()), 1e-9)), dtype=np.float32)


def unlikeness(a: NDArray[np.floating], b: NDArray[np.floating]) -> float:
    """Hellinger distance of two appearances: 0 the same, 1 nothing in common."""
    return float(np.sqrt(max(0.0, 1.0 - float(a @ b))))


def _patch(
    frame: NDArray[np.uint8], hips: NDArray[np.floating], up: NDArray[np.floating], across: NDArray[np.floating],
    span: tuple[float, float],
) -> NDArray[np.uint8]:  # fmt: skip
    """Colours [PATCH,PATCH,3] on a grid along the torso; those outside of the picture are its border's."""
    along, beside = np.meshgrid(np.linspace(*span, PATCH), np.linspace(-1, 1, PATCH), indexing="ij")
    points = (hips + along[..., None] * up + beside[..., None] * across - 0.5).astype(np.float32)
    picked = cv2.remap(frame, points[..., 0], points[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(picked, np.uint8)


def _histogram(patch: NDArray[np.uint8]) -> NDArray[np.float32]:
    lab = cv2.cvtColor(patch, cv2.COLOR_RGB2LAB)
    # Most clothes' colours lie in the middle of the two axes' range; the others count at its ends.
    lab[..., 1:] = np.clip(lab[..., 1:], COLOURS[0], COLOURS[1] - 1)
    counts = cv2.calcHist([lab], [0, 1, 2], None, list(BINS), [0, 256, *COLOURS, *COLOURS])
    return np.asarray(gaussian_filter(counts, SOFTEN, mode="constant"), np.float32).ravel()
