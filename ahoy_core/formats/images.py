"""PNG files, conversions between 8-bit and float images, and contact sheets."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from ahoy_core.formats.atomic import atomic_path
from ahoy_core.formats.errors import ImageError

_TO_CV = {3: cv2.COLOR_RGB2BGR, 4: cv2.COLOR_RGBA2BGRA}
_FROM_CV = {3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGBA}
_LABEL_HEIGHT = 18
_GAP = 4
_PAPER = 255
_INK = (30, 30, 30)


def read_png(path: str | Path) -> np.ndarray:
    """Read a PNG without changing its values.

    Args:
        path: the file.

    Returns:
        uint8 or uint16 [H,W] (grey), [H,W,3] (RGB) or [H,W,4] (RGBA, straight alpha).

    Raises:
        FileNotFoundError: no such file.
        ImageError: the file is no image, or damaged.
    """
    data = np.frombuffer(Path(path).read_bytes(), np.uint8)
    image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    if image is None:
        raise ImageError(f"expected a PNG image, got {Path(path).name!r} ({data.size} bytes, unreadable)")
    return image if image.ndim == 2 else cv2.cvtColor(image, _FROM_CV[image.shape[2]])


def write_png(path: str | Path, image: np.ndarray) -> None:
    """Write a PNG, losslessly; an older file stays until the new one is complete.

    Args:
        path: target.
        image: uint8 or uint16 [H,W], [H,W,3] (RGB) or [H,W,4] (RGBA, straight alpha).

    Raises:
        ImageError: another dtype or shape.
    """
    channels = image.shape[2] if image.ndim == 3 else 1
    if (
        image.dtype not in (np.uint8, np.uint16)
        or image.ndim not in (2, 3)
        or channels not in (1, 3, 4)
        or not image.size
    ):
        raise ImageError(
            f"expected a non-empty uint8 or uint16 [H,W], [H,W,3] or [H,W,4], got {image.dtype} {list(image.shape)}: "
            "convert floats with to_uint8"
        )
    stored = cv2.cvtColor(image, _TO_CV[channels]) if channels in _TO_CV else image
    _, data = cv2.imencode(".png", stored)
    with atomic_path(path) as temporary:
        temporary.write_bytes(data.tobytes())


def to_float(images: np.ndarray) -> Tensor:
    """8-bit channel-last -> float channel-first.

    Args:
        images: uint8 [...,H,W,C].

    Returns:
        float32 [...,C,H,W] in [0,1], on the CPU.

    Raises:
        ImageError: another dtype or fewer than three dimensions.
    """
    if images.dtype != np.uint8 or images.ndim < 3:
        raise ImageError(f"expected uint8 [...,H,W,C], got {images.dtype} {list(images.shape)}")
    channel_first = np.ascontiguousarray(np.moveaxis(images, -1, -3))
    return torch.from_numpy(channel_first).to(torch.float32) / 255.0


def to_uint8(images: Tensor) -> np.ndarray:
    """Float channel-first -> 8-bit channel-last, rounded to the nearest level; values outside [0,1] are clipped.

    Args:
        images: floating point [...,C,H,W]; NaN becomes 0.

    Returns:
        uint8 [...,H,W,C].

    Raises:
        ImageError: not floating point, or fewer than three dimensions.
    """
    if not images.is_floating_point() or images.ndim < 3:
        raise ImageError(f"expected a floating point [...,C,H,W], got {images.dtype} {list(images.shape)}")
    levels = (torch.nan_to_num(images.detach()).clamp(0.0, 1.0) * 255.0).round().to(torch.uint8)
    return np.ascontiguousarray(np.moveaxis(levels.cpu().numpy(), -3, -1))


def contact_sheet(
    images: Sequence[np.ndarray],
    labels: Sequence[str] | None = None,
    columns: int | None = None,
    cell: int | None = None,
) -> np.ndarray:
    """Lay pictures out in a grid on white, left to right and top to bottom, a label above each.

    Args:
        images: uint8 [H,W,3] each, sizes may differ.
        labels: one text a picture; characters outside ASCII are shown as "?".
        columns: pictures a row; None for a grid about as wide as high.
        cell: longest side in pixels to which larger pictures are reduced (area filter); None leaves them.

    Returns:
        uint8 [H,W,3].

    Raises:
        ImageError: no pictures, a wrong dtype or shape, or a number of labels that does not fit.
    """
    _check_sheet(images, labels, columns)
    pictures = [_reduced(image, cell) for image in images]
    per_row = min(columns or math.ceil(math.sqrt(len(pictures))), len(pictures))
    head = _LABEL_HEIGHT if labels else 0
    high = max(p.shape[0] for p in pictures) + head
    wide = max(p.shape[1] for p in pictures)
    rows = math.ceil(len(pictures) / per_row)
    sheet = np.full((rows * (high + _GAP) + _GAP, per_row * (wide + _GAP) + _GAP, 3), _PAPER, np.uint8)
    for number, picture in enumerate(pictures):
        top = _GAP + (number // per_row) * (high + _GAP)
        left = _GAP + (number % per_row) * (wide + _GAP)
        if labels:
            _write_label(sheet[top : top + head, left : left + wide], labels[number])
        sheet[top + head : top + head + picture.shape[0], left : left + picture.shape[1]] = picture
    return sheet


def _check_sheet(images: Sequence[np.ndarray], labels: Sequence[str] | None, columns: int | None) -> None:
    if not images:
        raise ImageError("expected at least one picture, got none")
    for number, image in enumerate(images):
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or not image.size:
            raise ImageError(f"expected uint8 [H,W,3], got {image.dtype} {list(image.shape)} as picture {number}")
    if labels is not None and len(labels) != len(images):
        raise ImageError(f"expected one label a picture ({len(images)}), got {len(labels)}")
    if columns is not None and columns < 1:
        raise ImageError(f"expected at least one column, got {columns}")


def _reduced(image: np.ndarray, cell: int | None) -> np.ndarray:
    longest = max(image.shape[:2])
    if cell is None or longest <= cell:
        return image
    height, width = (max(1, round(side * cell / longest)) for side in image.shape[:2])
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)


def _write_label(strip: np.ndarray, label: str) -> None:
    canvas = np.ascontiguousarray(strip)
    text = label.encode("ascii", "replace").decode()
    cv2.putText(canvas, text, (2, strip.shape[0] - 5), cv2.FONT_HERSHEY_SIMPLEX, 0.42, _INK, 1, cv2.LINE_AA)
    strip[:] = canvas
