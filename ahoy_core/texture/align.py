"""Shift of a frame against what the atlas shows: fits err by pixels, and first write wins keeps every seam for good."""

from __future__ import annotations

import numpy as np

from ahoy_core.texture.rays import FloatArray, IntArray
from ahoy_core.texture.texels import sample_image

# Texels compared: enough for a mean over the whole body, few enough for a few milliseconds.
COMPARED = 2000
# Fewer than this many texels in common say nothing.
LEAST_COMMON = 200
# A colour difference beyond this many levels is another thing, not a shift: it counts no more than this.
DIFFERENCE_CAP = 60.0
# A shift has to lower the difference by this share; else shading, not place, explains it.
LEAST_GAIN = 0.03


def best_shift(image: IntArray, pixels: FloatArray, colours: FloatArray, reach: float) -> tuple[float, float]:
    """The shift (x, y) in pixels, at most `reach` along each axis, at which a frame agrees best with known colours.

    Coarse to fine: steps of 2, 1 and 0.5 pixels around the best so far, by capped mean absolute difference.

    Args:
        image: [H,W,3] uint8 sRGB.
        pixels: [N,2] where the fit sees texels of known colour.
        colours: [N,3] these colours, 0..255.
        reach: pixels, >= 0.

    Returns:
        (0, 0) where too few texels are known or no shift is clearly better.
    """
    if len(pixels) < LEAST_COMMON or reach <= 0:
        return 0.0, 0.0
    pixels, colours = pixels[:: -(-len(pixels) // COMPARED)], colours[:: -(-len(colours) // COMPARED)]

    def difference(shift: FloatArray) -> float:
        gap = np.abs(sample_image(image, pixels + shift) - colours)
        return float(np.minimum(gap, DIFFERENCE_CAP).mean())

    best = np.zeros(2)
    start = lowest = difference(best)
    for step, span in ((2.0, reach), (1.0, 1.0), (0.5, 0.5)):
        centre, ticks = best, np.arange(-(span // step), span // step + 1) * step
        for dx in ticks:
            for dy in ticks:
                shift = centre + np.array([dx, dy])
                if np.abs(shift).max() <= reach and (found := difference(shift)) < lowest:
                    best, lowest = shift, found
    if lowest > (1 - LEAST_GAIN) * start:
        return 0.0, 0.0
    return float(best[0]), float(best[1])
