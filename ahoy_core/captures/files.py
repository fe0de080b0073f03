"""What the readers share: pictures, undistortion, errors that say what is missing."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ahoy_core.conventions import Cameras


def read_picture(path: Path) -> NDArray[np.uint8]:
    """A picture as stored: [H,W] grey, [H,W,3] RGB or [H,W,4] RGBA, uint8.

    Raises:
        ValueError: it cannot be read.
    """
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise ValueError(f"expected a picture at {path}, got none that can be read; is the capture complete?")
    if image.ndim == 3:
        image = cv2.cvtColor(image, cv2.COLOR_BGRA2RGBA if image.shape[2] == 4 else cv2.COLOR_BGR2RGB)
    return np.asarray(image, dtype=np.uint8)


def read_mask(path: Path) -> NDArray[np.uint8]:
    """A mask [H,W] uint8: the only channel, alpha, or the largest colour channel."""
    image = read_picture(path)
    if image.ndim == 2:
        return image
    return np.asarray(image[..., 3] if image.shape[2] == 4 else image.max(-1), dtype=np.uint8)


def read_json(path: Path) -> Any:
    """A JSON file.

    Raises:
        ValueError: there is none, or it is damaged.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ValueError(f"expected JSON in {path}, got {error}; is the capture complete?") from error


def camera(K: Any, R: Any, t: Any, width: int, height: int) -> Cameras:
    """One camera from K [3,3], R [3,3] and t [3] (world -> camera, OpenCV axes, metres)."""
    viewmat = torch.eye(4)
    viewmat[:3, :3] = torch.as_tensor(np.asarray(R, dtype=np.float64)).float()
    viewmat[:3, 3] = torch.as_tensor(np.asarray(t, dtype=np.float64)).float().reshape(3)
    matrix = torch.as_tensor(np.asarray(K, dtype=np.float64)).float().reshape(3, 3)
    return Cameras(viewmat[None], matrix[None], width, height, "pinhole")


def undistorted(image: NDArray[np.uint8], K: Tensor, distortion: Sequence[float]) -> NDArray[np.uint8]:
    """The picture that a camera without distortion and of the same K would have taken."""
    coefficients = np.asarray(distortion, dtype=np.float64).reshape(-1)
    if not coefficients.any():
        return image
    matrix = K.double().numpy().copy()
    matrix[:2, 2] -= 0.5  # OpenCV's pixel centres are at whole numbers
    return np.asarray(cv2.undistort(image, matrix, coefficients), dtype=np.uint8)


def unit(image: NDArray[np.uint8]) -> Tensor:
    """[H,W] or [H,W,C] uint8 -> [H,W] or [C,H,W] float32 in [0,1]."""
    tensor = torch.from_numpy(np.ascontiguousarray(image)).float() / 255
    return tensor if tensor.ndim == 2 else tensor.permute(2, 0, 1)
