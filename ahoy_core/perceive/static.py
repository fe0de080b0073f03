"""What a still camera gives away: a pixel that looks as before can't have turned from furniture into a person.

The networks' masks spill over furniture in front of a person, here in one frame, there in another, while those pixels
never change. So wherever a pixel shows its usual colour, its mask is held at or below a low quantile of the values it
got when it looked like that. With a moving camera few pixels keep a usual colour, and nothing happens.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

MIN_FRAMES = 8  # fewer tell nothing about what is usual
MAX_SAMPLES = 48  # frames that the statistics are taken from
SAME_COLOUR = 4.0  # of 255, after smoothing: what noise and compression leave
SMOOTHING = 1.5  # pixels
QUANTILE = 0.1


def hold_static(frames: NDArray[np.uint8], masks: NDArray[np.uint8], shots: NDArray[np.integer]) -> NDArray[np.uint8]:
    """Lower masks where a pixel looks as usual but was not always taken for the person.

    Args:
        frames: [T,H,W,3] sRGB.
        masks: [T,H,W], 0 to 255.
        shots: [T]; each shot is judged on its own.

    Returns:
        [T,H,W], nowhere above `masks`. Shots of fewer than 8 frames are returned as they are.
    """
    held = masks.copy()
    for shot in np.unique(shots):
        inside = np.flatnonzero(shots == shot)
        if len(inside) < MIN_FRAMES:
            continue
        samples = inside[np.unique(np.linspace(0, len(inside) - 1, MAX_SAMPLES).round().astype(int))]
        usual = np.median(frames[samples], axis=0).astype(np.float32)
        ceiling = _ceiling(frames[samples], masks[samples], usual)
        for t in inside:
            same = _looks_usual(frames[t], usual)
            held[t][same] = np.minimum(masks[t], ceiling)[same]
    return held


def _looks_usual(frame: NDArray[np.uint8], usual: NDArray[np.float32]) -> NDArray[np.bool_]:
    difference = cv2.GaussianBlur(frame.astype(np.float32) - usual, (0, 0), SMOOTHING)
    return np.asarray(np.abs(difference).max(axis=-1) < SAME_COLOUR)


def _ceiling(frames: NDArray[np.uint8], masks: NDArray[np.uint8], usual: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Low quantile [H,W] of the masks over the frames in which the pixel looks as usual; 255 where it rarely does."""
    same = np.stack([_looks_usual(frame, usual) for frame in frames])
    # Frames that look different sort to the end, so the quantile is a row of the sorted stack.
    ordered = np.sort(np.where(same, masks, np.uint8(255)), axis=0)
    count = same.sum(axis=0)
    row = np.floor(QUANTILE * np.maximum(count - 1, 0)).astype(np.int64)
    ceiling = np.take_along_axis(ordered, row[None], axis=0)[0]
    return np.where(count >= MIN_FRAMES // 2, ceiling, np.uint8(255)).astype(np.uint8)
