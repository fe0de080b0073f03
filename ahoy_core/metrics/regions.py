"""Which pixels of a picture count."""

from __future__ import annotations

import torch
from torch import Tensor


def mask_box(mask: Tensor, margin: int = 0) -> tuple[int, int, int, int]:
    """Box x0, y0, x1, y1 (half open, pixels) of what is above 0.01 in a mask [H,W] in [0,1].

    Args:
        mask: [H,W] alpha.
        margin: Pixels by which the box is widened, within the image.

    Raises:
        ValueError: If the mask is empty.
    """
    inside = mask > 0.01
    if not bool(inside.any()):
        raise ValueError("expected a mask with something in it, got an empty one; leave the frame out")
    rows, columns = torch.nonzero(inside.any(1))[:, 0], torch.nonzero(inside.any(0))[:, 0]
    x0, y0 = max(0, int(columns[0]) - margin), max(0, int(rows[0]) - margin)
    x1, y1 = min(mask.shape[1], int(columns[-1]) + 1 + margin), min(mask.shape[0], int(rows[-1]) + 1 + margin)
    return x0, y0, x1, y1
