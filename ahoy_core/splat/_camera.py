"""One camera as the flat float64 vector that the kernels read."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ahoy_core.splat.constants import FRUSTUM_MARGIN

ROTATION: Final = 0  # 9 values, row-major
TRANSLATION: Final = 9  # 3 values
FX, FY, CX, CY = 12, 13, 14, 15
X_MIN, X_MAX, Y_MIN, Y_MAX = 16, 17, 18, 19  # limits of x / z and y / z in the Jacobian
ORTHO: Final = 20
WIDTH, HEIGHT = 21, 22
NEAR, FAR = 23, 24
EPS2D, RADIUS_CLIP = 25, 26
LOG2_CUTOFF: Final = 27
SIZE: Final = 28


@dataclass(frozen=True)
class View:
    """What all cameras of one call share."""

    width: int
    height: int
    near_plane: float
    far_plane: float
    eps2d: float
    radius_clip: float
    alpha_cutoff: float
    ortho: bool
    antialiased: bool


def pack_cameras(viewmats: NDArray[Any], Ks: NDArray[Any], view: View) -> NDArray[np.float64]:
    """Flatten viewmats [C,4,4] world -> camera and Ks [C,3,3] pixels to [C,SIZE]."""
    packed = np.empty((len(viewmats), SIZE))
    packed[:, ROTATION:TRANSLATION] = viewmats[:, :3, :3].reshape(-1, 9)
    packed[:, TRANSLATION:FX] = viewmats[:, :3, 3]
    Ks = Ks.astype(np.float64)
    fx, fy, cx, cy = Ks[:, 0, 0], Ks[:, 1, 1], Ks[:, 0, 2], Ks[:, 1, 2]
    packed[:, FX], packed[:, FY], packed[:, CX], packed[:, CY] = fx, fy, cx, cy
    packed[:, X_MIN] = -(cx + FRUSTUM_MARGIN * view.width) / fx
    packed[:, X_MAX] = ((1 + FRUSTUM_MARGIN) * view.width - cx) / fx
    packed[:, Y_MIN] = -(cy + FRUSTUM_MARGIN * view.height) / fy
    packed[:, Y_MAX] = ((1 + FRUSTUM_MARGIN) * view.height - cy) / fy
    packed[:, ORTHO] = view.ortho
    packed[:, WIDTH], packed[:, HEIGHT] = view.width, view.height
    packed[:, NEAR], packed[:, FAR] = view.near_plane, view.far_plane
    packed[:, EPS2D], packed[:, RADIUS_CLIP] = view.eps2d, view.radius_clip
    packed[:, LOG2_CUTOFF] = np.log2(view.alpha_cutoff)
    return packed
