"""The rotated square that a person is cropped with, and the way back from the crop to the image.

Image coordinates are pixels with pixel centres at +0.5; crop coordinates (u, v) run from 0 to 1 over the square.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

MARGIN = 1.25  # of the square over the circle round the body (the landmark network was trained with it)
OVERSAMPLE_FROM = 2.0  # image pixels per crop pixel from which plain interpolation would skip pixels


@dataclass(frozen=True)
class Roi:
    """A square: centre and side in image pixels, rotation in radians (clockwise in the image, 0 = upright)."""

    cx: float
    cy: float
    size: float
    angle: float

    def matrix(self) -> NDArray[np.float64]:
        """Return [2,3], taking (u, v, 1) to image pixels."""
        c, s = math.cos(self.angle) * self.size, math.sin(self.angle) * self.size
        return np.array([[c, -s, self.cx - 0.5 * (c - s)], [s, c, self.cy - 0.5 * (s + c)]])

    def to_image(self, uv: NDArray[np.floating]) -> NDArray[np.float64]:
        """Take crop coordinates [...,2] in [0,1] to image pixels."""
        matrix = self.matrix()
        return np.asarray(uv @ matrix[:, :2].T + matrix[:, 2])

    def to_crop(self, xy: NDArray[np.floating]) -> NDArray[np.float64]:
        """Take image pixels [...,2] to crop coordinates."""
        matrix = self.matrix()
        return np.asarray((xy - matrix[:, 2]) @ np.linalg.inv(matrix[:, :2]).T)

    def box(self) -> NDArray[np.float64]:
        """Return the axis-aligned box x0, y0, x1, y1 round the square."""
        corners = self.to_image(np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]))
        return np.concatenate([corners.min(0), corners.max(0)])


def roi_from_points(centre: NDArray[np.floating], top: NDArray[np.floating]) -> Roi:
    """Build the crop from two points: the hips' centre, and a point above the head on the circle round the body.

    Args:
        centre: [2] image pixels.
        top: [2] image pixels.
    """
    dx, dy = (np.asarray(top, dtype=np.float64) - centre).tolist()
    angle = math.pi / 2 - math.atan2(-dy, dx)
    angle -= 2 * math.pi * math.floor((angle + math.pi) / (2 * math.pi))
    return Roi(float(centre[0]), float(centre[1]), max(2.0 * MARGIN * math.hypot(dx, dy), 1.0), angle)


def sample(frame: NDArray[np.uint8], roi: Roi, size: int) -> NDArray[np.float32]:
    """Cut the square out of a frame.

    Small people are enlarged with cubic interpolation, large ones averaged down; outside of the frame it is black.

    Args:
        frame: [H,W,3] sRGB.
        roi: the square.
        size: side of the result in pixels.

    Returns:
        [size,size,3] in [0,1].
    """
    factor = 2 if roi.size / size > OVERSAMPLE_FROM else 1
    fine = size * factor
    flags = cv2.WARP_INVERSE_MAP | (cv2.INTER_CUBIC if roi.size < size else cv2.INTER_LINEAR)
    crop = cv2.warpAffine(frame, _index_matrix(roi, fine), (fine, fine), flags=flags)
    if factor > 1:
        crop = cv2.resize(crop, (size, size), interpolation=cv2.INTER_AREA)
    return crop.astype(np.float32) / 255.0


def paste(mask: NDArray[np.floating], roi: Roi, height: int, width: int) -> NDArray[np.float32]:
    """Lay a square mask [N,N] back into the image; 0 outside of the square. Returns [height,width]."""
    matrix = cv2.invertAffineTransform(_index_matrix(roi, mask.shape[0]))
    return np.asarray(
        cv2.warpAffine(mask.astype(np.float32), matrix, (width, height), flags=cv2.WARP_INVERSE_MAP | cv2.INTER_LINEAR),
        dtype=np.float32,
    )


def _index_matrix(roi: Roi, size: int) -> NDArray[np.float64]:
    """Return [2,3] from crop pixel indices to image pixel indices (OpenCV puts pixel centres at integers)."""
    matrix = roi.matrix()
    linear = matrix[:, :2] / size
    offset = linear @ np.array([0.5, 0.5]) + matrix[:, 2] - 0.5
    return np.concatenate([linear, offset[:, None]], axis=1)
