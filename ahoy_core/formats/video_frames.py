"""One decoded picture -> upright 8-bit RGB with square pixels, at the wanted size."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import Any, NamedTuple

import av
import cv2
import numpy as np
from av.video.reformatter import ColorRange, Colorspace, Interpolation

GREY = 128  # 0.5, what transparent places are composited over
_EXACT = Interpolation.FULL_CHR_H_INT | Interpolation.ACCURATE_RND
_BAND = 256  # rows composited at a time, so that an 8K picture needs no second full-size float copy
_HD_LINES = 720
_RIGHT_ANGLE_TOLERANCE = 1e-3


class Size(NamedTuple):
    """Width and height in pixels."""

    width: int
    height: int


@dataclass(frozen=True)
class Orientation:
    """How stored pixels are turned for display: first the transpose, then the flips."""

    transpose: bool = False
    flip_x: bool = False
    flip_y: bool = False
    right_angle: bool = True

    @property
    def mirrored(self) -> bool:
        """The picture is seen from behind, not only turned."""
        return self.transpose ^ self.flip_x ^ self.flip_y

    @property
    def clockwise(self) -> int:
        """Degrees by which the stored picture is turned, after a flip left to right if `mirrored`: 0, 90, 180, 270."""
        if self.transpose:
            return 90 if self.flip_x else 270
        return 180 if self.flip_y else 0

    def apply(self, image: np.ndarray) -> np.ndarray:
        """Turn [H,W,C] into display orientation, contiguous."""
        turned = image.swapaxes(0, 1) if self.transpose else image
        turned = turned[:, ::-1] if self.flip_x else turned
        turned = turned[::-1] if self.flip_y else turned
        return np.ascontiguousarray(turned)


def orientation_of(frame: av.VideoFrame) -> Orientation:
    """Read the display matrix of a decoded frame (ISO/IEC 14496-12, 8.3.2: x' = a x + c y, y' = b x + d y)."""
    side_data: Any = frame.side_data.get("DISPLAYMATRIX")
    if side_data is None:
        return Orientation()
    a, b, _, c, d = (float(value) for value in np.frombuffer(bytes(side_data), "<i4")[:5])
    if not any((a, b, c, d)):
        return Orientation()
    if abs(a) + abs(d) >= abs(b) + abs(c):
        off_axis = (abs(b) + abs(c)) / (abs(a) + abs(d))
        return Orientation(False, a < 0, d < 0, off_axis < _RIGHT_ANGLE_TOLERANCE)
    off_axis = (abs(a) + abs(d)) / (abs(b) + abs(c))
    return Orientation(True, c < 0, b < 0, off_axis < _RIGHT_ANGLE_TOLERANCE)


def square_pixel_size(width: int, height: int, pixel_aspect: Fraction) -> Size:
    """Size at which pixels are square; the side that would shrink is kept and the other one grows."""
    if pixel_aspect >= 1:
        return Size(max(1, round(width * pixel_aspect)), height)
    return Size(width, max(1, round(height / pixel_aspect)))


def limited(size: Size, max_size: int | None) -> Size:
    """Reduce to at most `max_size` on the longest side, keeping the proportions; never enlarge."""
    longest = max(size)
    if max_size is None or longest <= max_size:
        return size
    return Size(*(max(1, round(side * max_size / longest)) for side in size))


def has_alpha(frame: av.VideoFrame) -> bool:
    """Whether the pixel format carries transparency."""
    return any(component.is_alpha for component in frame.format.components)


def to_rgb(frame: av.VideoFrame, size: Size) -> np.ndarray:
    """Convert a stored picture to RGB at `size` (before display orientation).

    Reducing uses an area filter on sRGB values. Straight alpha is composited over grey 0.5 before that. Untagged video
    of 720 lines or more is read as BT.709, smaller video as BT.601, as players do.

    Args:
        frame: a decoded frame of any pixel format.
        size: wanted size.

    Returns:
        uint8 [H,W,3].
    """
    if has_alpha(frame):
        return _resized(_over_grey(_converted(frame, Size(frame.width, frame.height), "rgba")), size)
    return _converted(frame, size, "rgb24")


def _converted(frame: av.VideoFrame, size: Size, pixel_format: str) -> np.ndarray:
    untagged = frame.colorspace == 2
    matrix = Colorspace.ITU709 if min(frame.width, frame.height) >= _HD_LINES else Colorspace.ITU601
    shrinks = size.width < frame.width or size.height < frame.height
    return frame.to_ndarray(
        width=size.width,
        height=size.height,
        format=pixel_format,
        src_colorspace=matrix if untagged and not frame.format.is_rgb else None,
        dst_color_range=ColorRange.JPEG,
        interpolation=(Interpolation.AREA if shrinks else Interpolation.BICUBIC) | _EXACT,
    )


def _over_grey(rgba: np.ndarray) -> np.ndarray:
    out = np.empty((*rgba.shape[:2], 3), np.uint8)
    for top in range(0, rgba.shape[0], _BAND):
        band = rgba[top : top + _BAND].astype(np.uint16)
        alpha = band[..., 3:]
        out[top : top + _BAND] = (band[..., :3] * alpha + GREY * (255 - alpha) + 127) // 255
    return out


def _resized(image: np.ndarray, size: Size) -> np.ndarray:
    if image.shape[1::-1] == tuple(size):
        return image
    shrinks = size.width < image.shape[1] or size.height < image.shape[0]
    return cv2.resize(image, tuple(size), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC)
