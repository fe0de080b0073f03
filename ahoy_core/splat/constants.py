"""Thresholds and constants of the rasterizer, each with why it has its value."""

from __future__ import annotations

import math
from typing import Final

ALPHA_CUTOFF: Final = 1 / 255
"""Contributions under one step of an 8-bit image are left out (gsplat, Kerbl et al. 2023)."""

ALPHA_MAX: Final = 0.999
"""Contributions are clamped here, so that 1 / (1 - alpha) stays below 1000 in the backward pass (gsplat). Forward and
backward use the same value: a clamped contribution has no gradient for its shape and opacity."""

TRANSMITTANCE_STOP: Final = 1e-4
"""A pixel ends before the Gaussian that would take it to this transmittance (gsplat): a 40th of an 8-bit step."""

MIN_ALPHA_CUTOFF: Final = 1e-30
"""Smallest cutoff accepted: 2**power must stay a normal float32 for every contribution that is kept."""

NEAR_PLANE: Final = 0.01
"""Metres (gsplat)."""

FAR_PLANE: Final = 1e10
"""Metres (gsplat)."""

EPS2D: Final = 0.3
"""Pixels^2 added to the projected covariance, a blur of about half a pixel (gsplat, Kerbl et al. 2023)."""

FRUSTUM_MARGIN: Final = 0.15
"""The pinhole Jacobian is taken no further out than this share of the image beyond its border (gsplat): the affine
approximation of the projection diverges towards 90 degrees."""

MAX_SH_DEGREE: Final = 3
"""Highest spherical harmonics of the standard 3DGS file layout."""

TILE_SIZES: Final = (8, 16, 32)
"""Pixels per side: multiples of the 4 x 4 block, so that the image does not depend on the choice."""

CHANNEL_COUNTS: Final = (1, 3, 4, 8, 16, 32)
"""Channels are padded to the next of these, which bounds the number of kernels ever compiled."""

LOG2E: Final = 1 / math.log(2)
LN2: Final = math.log(2)
KAPPA: Final = 0.5 * LOG2E
"""exp(-sigma^2 / 2) = 2**(-KAPPA sigma^2)."""

SLACK: Final = 1e-3
"""Culling regions are widened by this share (and absolute amount) of the exponent, so that float32 rounding in the
culling never removes a contribution that the pixel's own test would keep."""

TINY: Final = 1e-30
"""Floor of the covariance factors (a Gaussian of 1e30 pixels): float32 can still square-root and divide by it."""
