"""Fills triangles; a compiled loop, because one call a triangle costs more than the triangle."""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray


@numba.njit(nogil=True, cache=True)  # type: ignore[misc, unused-ignore]
def _fill(canvas: NDArray[np.uint8], points: NDArray[np.float64], triangles: NDArray[np.int64]) -> None:
    height, width = canvas.shape
    for i in range(len(triangles)):
        a, b, c = triangles[i]
        ax, ay, bx, by, cx, cy = points[a, 0], points[a, 1], points[b, 0], points[b, 1], points[c, 0], points[c, 1]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if area == 0.0:
            continue
        sign = 1.0 if area > 0 else -1.0
        top = max(0, math.ceil(min(ay, by, cy) - 0.5))
        bottom = min(height - 1, math.floor(max(ay, by, cy) - 0.5))
        left = max(0, math.ceil(min(ax, bx, cx) - 0.5))
        right = min(width - 1, math.floor(max(ax, bx, cx) - 0.5))
        for row in range(top, bottom + 1):
            y = row + 0.5
            for column in range(left, right + 1):
                x = column + 0.5
                if (
                    sign * ((bx - ax) * (y - ay) - (by - ay) * (x - ax)) >= 0
                    and sign * ((cx - bx) * (y - by) - (cy - by) * (x - bx)) >= 0
                    and sign * ((ax - cx) * (y - cy) - (ay - cy) * (x - cx)) >= 0
                ):
                    canvas[row, column] = 255


def fill_triangles(canvas: NDArray[np.uint8], points: NDArray[np.floating], triangles: NDArray[np.integer]) -> None:
    """Set pixels whose centres (at +0.5) lie in a triangle or on its edge to 255, in place.

    Args:
        canvas: [H,W].
        points: [V,2] x, y in pixels, finite.
        triangles: [M,3] indices, wound either way; those without area draw nothing.
    """
    _fill(canvas, np.ascontiguousarray(points, np.float64), np.ascontiguousarray(triangles, np.int64))
