"""The guided filter (He, Sun, Tang, 2010) with a colour guide: a mask's edges move to the picture's, and stay soft.

Written out because OpenCV 5.0.0's `ximgproc.guidedFilter` does not compute it: with a colour guide its result differs
from the definition by up to 0.5 of the mask's range, and smaller `eps` blurs more.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray


def guided_filter(
    guide: NDArray[np.float32], mask: NDArray[np.float32], radius: int, eps: float
) -> NDArray[np.float32]:
    """Filter a mask by local linear models of the guide's colours.

    Args:
        guide: [H,W,3] in [0,1].
        mask: [H,W].
        radius: of the box windows, pixels.
        eps: colour variance below which a window counts as flat.

    Returns:
        [H,W], a little outside of the mask's range where the models overshoot.
    """

    def mean(image: NDArray[np.float32]) -> NDArray[np.float32]:
        window = (2 * radius + 1, 2 * radius + 1)
        return np.asarray(cv2.boxFilter(np.ascontiguousarray(image), -1, window, borderType=cv2.BORDER_REFLECT))

    mean_guide, mean_mask = mean(guide), mean(mask)
    products = guide[..., :, None] * guide[..., None, :]
    second = mean(products.reshape(*mask.shape, 9)).reshape(*mask.shape, 3, 3)
    variance = second - mean_guide[..., :, None] * mean_guide[..., None, :] + eps * np.eye(3, dtype=np.float32)
    covariance = mean(guide * mask[..., None]) - mean_guide * mean_mask[..., None]
    slope = np.linalg.solve(variance, covariance[..., None])[..., 0]
    offset = mean_mask - (slope * mean_guide).sum(-1)
    return np.asarray((mean(slope) * guide).sum(-1) + mean(offset), dtype=np.float32)
