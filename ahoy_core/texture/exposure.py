"""Exposure drift: a camera that brightens or darkens during the clip must not leave its steps in the atlas.

Each frame is brought to the exposure of what is known already (the consensus, else what was written), per channel,
before it votes or writes. The relation is estimated on the same texels in both, whatever the frame shows.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ahoy_core.texture.rays import FloatArray, IntArray

ExposureMatch = Literal["off", "gain", "gamma"]

# Fewer texels in common than this say nothing about the exposure.
LEAST_COMMON = 500
# Levels whose logarithm is all noise, or which are clipped.
DARKEST, BRIGHTEST = 10.0, 245.0
# Ratios within this of 1 are shading on a moving body, not the camera: frames are left as they are.
LEAST_GAIN = 0.03
# No camera drifts by more within a clip; beyond, the fit or the mask is wrong.
GAIN_RANGE = (0.5, 2.0)
GAMMA_RANGE = (0.7, 1.4)


@dataclass(frozen=True)
class Exposure:
    """Per channel: known = gain * seen^gamma, colours in (0,1]; gain [3], gamma [3]."""

    gain: FloatArray
    gamma: FloatArray

    def apply(self, image: IntArray) -> IntArray:
        """The image [H,W,3] uint8 at the known exposure."""
        levels = np.arange(256) / 255
        table = 255 * self.gain * levels[:, None] ** self.gamma
        rounded = np.clip(np.rint(table), 0, 255).astype(np.uint8)
        return np.stack([rounded[image[..., channel], channel] for channel in range(3)], axis=-1)


def match_exposure(seen: FloatArray, known: FloatArray, mode: ExposureMatch) -> Exposure | None:
    """How a frame's colours relate to the known ones of the same texels.

    Args:
        seen: [N,3] colours in the frame, 0..255.
        known: [N,3] colours known of the same texels, 0..255.
        mode: "gain": a factor a channel, the median ratio (indifferent to outliers). "gamma": an exponent too, the
            ratio of the spreads of the logarithms (unlike a regression, not biased towards 1 by noise in both).

    Returns:
        None where too little is in common, or nothing has to be changed.
    """
    gain, gamma = np.ones(3), np.ones(3)
    if mode == "off":
        return None
    for channel in range(3):
        a, b = seen[:, channel].astype(np.float64), known[:, channel].astype(np.float64)
        fair = (np.minimum(a, b) > DARKEST) & (np.maximum(a, b) < BRIGHTEST)
        if fair.sum() < LEAST_COMMON:
            return None
        log_a, log_b = np.log(a[fair] / 255), np.log(b[fair] / 255)
        if mode == "gamma":
            spread_a, spread_b = (float(np.subtract(*np.quantile(x, [0.75, 0.25]))) for x in (log_a, log_b))
            gamma[channel] = np.clip(spread_b / spread_a if spread_a > 0.1 else 1.0, *GAMMA_RANGE)
        gain[channel] = np.clip(np.exp(np.median(log_b - gamma[channel] * log_a)), *GAIN_RANGE)
    if np.abs(gain - 1).max() < LEAST_GAIN and np.abs(gamma - 1).max() < LEAST_GAIN:
        return None
    return Exposure(gain, gamma)
