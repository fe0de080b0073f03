"""Counts and lists the (Gaussian, pixel) pairs of a scene: the work that no rasterizer can avoid."""

from __future__ import annotations

import numpy as np
from numba import njit

CUTOFF, STOP = 1.0 / 255.0, 1e-4


@njit(cache=True)
def _walk(means2d, conics, opacities, width, height, tile, offsets, ids, gaussians, pixels):  # type: ignore[no-untyped-def]
    tiles = (width + tile - 1) // tile
    evaluated = 0
    found = 0
    for y in range(height):
        for x in range(width):
            index = (y // tile) * tiles + x // tile
            keep = 1.0
            for k in range(offsets[index], offsets[index + 1]):
                g = ids[k]
                dx, dy = x + 0.5 - means2d[g, 0], y + 0.5 - means2d[g, 1]
                evaluated += 1
                power = 0.5 * (conics[g, 0] * dx * dx + conics[g, 2] * dy * dy) + conics[g, 1] * dx * dy
                alpha = min(0.999, opacities[g] * np.exp(-power))
                if power < 0 or alpha < CUTOFF:
                    continue
                left = keep * (1 - alpha)
                if left <= STOP:
                    break
                if len(gaussians):
                    gaussians[found], pixels[found] = g, y * width + x
                found += 1
                keep = left
    return evaluated, found


def count_pairs(
    means2d: np.ndarray,
    conics: np.ndarray,
    opacities: np.ndarray,
    width: int,
    height: int,
    tile: int,
    offsets: np.ndarray,
    ids: np.ndarray,
) -> tuple[int, int]:
    """Return how many pairs the tile lists hold up to each pixel's end, and how many of them blend."""
    none = np.empty(0, np.int64)
    return _walk(means2d, conics, opacities, width, height, tile, offsets, ids, none, none)


def blended_pairs(
    means2d: np.ndarray,
    conics: np.ndarray,
    opacities: np.ndarray,
    width: int,
    height: int,
    tile: int,
    offsets: np.ndarray,
    ids: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the Gaussian and pixel index of every pair that blends, by pixel, near to far."""
    _, found = count_pairs(means2d, conics, opacities, width, height, tile, offsets, ids)
    gaussians, pixels = np.empty(found, np.int64), np.empty(found, np.int64)
    _walk(means2d, conics, opacities, width, height, tile, offsets, ids, gaussians, pixels)
    return gaussians, pixels
