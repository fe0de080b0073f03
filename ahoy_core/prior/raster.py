"""A z-buffer for people: which triangle covers each pixel, and where in it (machine code, one core)."""

from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

_ALPHA_CUT = 110  # of 255: strips of hair end here
_FAR = 1e9

_kernel = numba.njit(nogil=True, cache=True, error_model="numpy")


class Hits(NamedTuple):
    """What pixels see: face [H,W] int32 (-1 nothing), bary [H,W,2] of corners 1 and 2, depth [H,W]."""

    face: Array
    bary: Array
    depth: Array


def rasterize(
    screen: Array, faces: Array, height: int, width: int, alpha: tuple[Array, Array, Array] | None = None
) -> Hits:
    """The nearest triangle of each pixel.

    Barycentric weights are linear in the image: at person images' distances (2.5 m and more) the perspective error
    inside one triangle of a body is far below a pixel.

    Args:
        screen: [V,3] float32: pixel u, pixel v, depth (any increasing measure).
        faces: [F,3] int32.
        height: pixels.
        width: pixels.
        alpha: (uvs [F,3,2], materials [F], textures [M,S,S,4] uint8) whose alpha cuts holes; None where all is solid.
    """
    hits = Hits(
        np.full((height, width), -1, dtype=np.int32),
        np.zeros((height, width, 2), dtype=np.float32),
        np.full((height, width), _FAR, dtype=np.float32),
    )
    if alpha is None:
        nothing = np.zeros((0, 3, 2), np.float32), np.zeros(0, np.int32), np.zeros((0, 1, 1, 4), np.uint8)
        _fill(screen, faces, *nothing, False, *hits)
    else:
        _fill(screen, faces, *alpha, True, *hits)
    return hits


@_kernel
def texel(image: Array, u: float, v: float) -> Array:
    """The texel [4] of an image [S,S,4] at texture coordinates (origin at the lower left, repeated)."""
    size = image.shape[0]
    column = int((u - np.floor(u)) * size) % size
    row = int((1.0 - (v - np.floor(v))) * size) % size
    return image[row, column]


@_kernel
def _fill(
    screen: Array,
    faces: Array,
    uvs: Array,
    materials: Array,
    textures: Array,
    cut: bool,
    face: Array,
    bary: Array,
    depth: Array,
) -> None:
    height, width = face.shape
    for f in range(faces.shape[0]):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        x0, y0, x1, y1, x2, y2 = screen[a, 0], screen[a, 1], screen[b, 0], screen[b, 1], screen[c, 0], screen[c, 1]
        left, right = int(np.ceil(min(x0, x1, x2) - 0.5)), int(np.floor(max(x0, x1, x2) - 0.5))
        top, bottom = int(np.ceil(min(y0, y1, y2) - 0.5)), int(np.floor(max(y0, y1, y2) - 0.5))
        if left > right or top > bottom:
            continue
        area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
        if abs(area) < 1e-9:
            continue
        inverse = 1.0 / area
        for j in range(max(0, top), min(height - 1, bottom) + 1):
            for i in range(max(0, left), min(width - 1, right) + 1):
                px, py = i + 0.5 - x0, j + 0.5 - y0
                w1 = (px * (y2 - y0) - (x2 - x0) * py) * inverse
                w2 = ((x1 - x0) * py - px * (y1 - y0)) * inverse
                w0 = 1.0 - w1 - w2
                if w0 < 0 or w1 < 0 or w2 < 0:
                    continue
                z = w0 * screen[a, 2] + w1 * screen[b, 2] + w2 * screen[c, 2]
                if z >= depth[j, i]:
                    continue
                if cut:
                    u = w0 * uvs[f, 0, 0] + w1 * uvs[f, 1, 0] + w2 * uvs[f, 2, 0]
                    v = w0 * uvs[f, 0, 1] + w1 * uvs[f, 1, 1] + w2 * uvs[f, 2, 1]
                    if texel(textures[materials[f]], u, v)[3] < _ALPHA_CUT:
                        continue
                depth[j, i] = z
                face[j, i] = f
                bary[j, i, 0] = w1
                bary[j, i, 1] = w2
