"""The orthonormal 2D Haar transform, which lets the StyleUNet work at half the resolution of its maps."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pixel_shuffle, pixel_unshuffle

_HAAR = ((0.5, 0.5, 0.5, 0.5), (0.5, -0.5, 0.5, -0.5), (0.5, 0.5, -0.5, -0.5), (0.5, -0.5, -0.5, 0.5))


def _matrix(like: Tensor) -> Tensor:
    return torch.tensor(_HAAR, dtype=like.dtype, device=like.device)


def haar(image: Tensor) -> Tensor:
    """Split an image into its four Haar bands.

    Args:
        image: [B,C,H,W], H and W even.

    Returns:
        [B,4C,H/2,W/2]; the bands of channel c are 4c .. 4c+3 (mean, horizontal, vertical, diagonal detail).

    Raises:
        ValueError: If H or W is odd.
    """
    batch, channels, height, width = image.shape
    if height % 2 or width % 2:
        raise ValueError(f"expected an even height and width, got {height}x{width}; pad the image to even sizes")
    blocks = pixel_unshuffle(image, 2).reshape(batch, channels, 4, -1)
    return torch.einsum("ij,bcjn->bcin", _matrix(image), blocks).reshape(batch, 4 * channels, height // 2, width // 2)


def inverse_haar(bands: Tensor) -> Tensor:
    """Put an image together from its four Haar bands: the exact inverse of `haar`.

    Args:
        bands: [B,4C,H,W] in the order of `haar`.

    Returns:
        [B,C,2H,2W].

    Raises:
        ValueError: If the number of channels is no multiple of four.
    """
    batch, channels, height, width = bands.shape
    if channels % 4:
        raise ValueError(f"expected a multiple of 4 channels (four bands each), got {channels}")
    blocks = bands.reshape(batch, channels // 4, 4, height * width)
    image = torch.einsum("ji,bcjn->bcin", _matrix(bands), blocks)
    return pixel_shuffle(image.reshape(batch, channels, height, width), 2)
