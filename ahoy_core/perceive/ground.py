"""Where the floor is known, somebody stands on it: that settles how far away they are, and so how large.

And stands upright: who stands has the trunk above the feet. Landmarks tell depth badly, so without that a person who
was seen from above leans by some degrees, feet on the floor and hips a hand's breadth behind them.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ahoy_core.conventions import OBSERVED_VIEWMAT

SOLES = (29, 30, 31, 32)  # heels and big toes
CLEARANCE = (0.05, 0.05, 0.03, 0.03)  # metres of these landmarks above the floor, shoes' soles included
SOFTNESS = 0.02  # metres above the lowest sole at which another one counts less
TRUNK = (11, 12, 23, 24)  # shoulders and hips
GROUND_SPREAD = 0.03  # metres
GROUND_SCALE = 0.2  # metres: width of Geman-McClure; who jumps or sits is left alone
BALANCE_SPREAD = 0.04  # metres: of the trunk before or beside the middle of the feet
BALANCE_SCALE = 0.2  # metres: width of Geman-McClure; who sits, lies or falls is left alone


def ground_from_camera(viewmat: NDArray[np.floating]) -> Tensor:
    """The floor [4] (`Observations.ground`) from where a camera stands.

    Args:
        viewmat: [4,4] world -> camera of a world whose z points up and whose floor is z = 0.
    """
    rotation, shift = np.asarray(viewmat, np.float64)[:3, :3], np.asarray(viewmat, np.float64)[:3, 3]
    up = rotation[:, 2]  # of the camera's axes
    height = -(rotation.T @ shift)[2]
    return torch.from_numpy(np.append(up @ OBSERVED_VIEWMAT[:3, :3].double().numpy(), height))


def lowest_sole(landmarks: Tensor, ground: Tensor) -> tuple[Tensor, Tensor]:
    """Height [N] in metres of the lowest sole above where it is when standing, from landmarks [N,33,3].

    A soft minimum: smooth where the weight goes from one foot to the other. Also its derivatives [N,4,3] by the soles.
    """
    heights = landmarks[:, list(SOLES)] @ ground[:3] + ground[3]
    heights = heights - heights.new_tensor(CLEARANCE)
    # Mostly two soles, heel and toe, are down together: their soft minimum is their height.
    lowest = SOFTNESS * (math.log(2) - torch.logsumexp(-heights / SOFTNESS, dim=1))
    return lowest, torch.softmax(-heights / SOFTNESS, dim=1)[..., None] * ground[:3]


def imbalance(landmarks: Tensor, ground: Tensor) -> Tensor:
    """How far the trunk is from above the middle of the soles, along the floor: [N,3] metres.

    Linear in the landmarks [N,33,3]; derivatives of theirs, [N,33,3,P] moved to [N,P,33,3], give those of the result.
    """
    apart = landmarks[..., list(TRUNK), :].mean(-2) - landmarks[..., list(SOLES), :].mean(-2)
    up = ground[:3]
    return apart - (apart @ up)[..., None] * up
