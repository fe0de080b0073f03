"""Where the floor is known, somebody stands on it: that settles how far away they are, and so how large.

And stands upright: who stands has the trunk above the feet. Landmarks tell depth badly, so without that a person who
was seen from above leans by some degrees, feet on the floor and hips a hand's breadth behind them.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ahoy_core.conventions import OBSERVED_VIEWMAT

SOLES = (29, 30, 31, 32)  # heels and big toes
CLEARANCE = (0.055, 0.055, 0.033, 0.033)  # metres of these landmarks above the floor, shoes' soles included
SOFTNESS = 0.02  # metres above the lower of two at which the other one counts less
# Where on the soles the trunk stands: a third of the way from heels to toes (4 cm behind the middle, over ten people).
BEARING = (0.35, 0.35, 0.15, 0.15)
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


def standing(landmarks: Tensor, ground: Tensor) -> tuple[Tensor, Tensor]:
    """Heights [N,2] in metres of the lower heel and of the lower toes above where they are when standing.

    Whoever stands or walks has both down, flat on one foot or, between two steps, a heel before and toes behind. One
    of the four alone would not do: a body that is too small and too near gets there on the tip of a toe.

    Args:
        landmarks: [N,33,3] metres, world.
        ground: [4], see `ground_from_camera`.

    Returns:
        Means that weigh the lower one, exact where both are down and where one is, and smooth between; and their
        derivatives [N,2,4,3] by `SOLES`.
    """
    heights = landmarks[:, list(SOLES)] @ ground[:3] + ground[3]
    heights = (heights - heights.new_tensor(CLEARANCE)).unflatten(1, (2, 2))  # heels, toes; left, right
    share = torch.softmax(-heights / SOFTNESS, dim=2)
    lowest = (share * heights).sum(2)
    slopes = share * (1 - (heights - lowest[..., None]) / SOFTNESS)
    return lowest, (torch.eye(2).to(slopes)[..., None] * slopes[:, None]).flatten(2)[..., None] * ground[:3]


def imbalance(landmarks: Tensor, ground: Tensor) -> Tensor:
    """How far the trunk is from above the soles, along the floor: [N,3] metres.

    Linear in the landmarks [N,33,3]; derivatives of theirs, [N,33,3,P] moved to [N,P,33,3], give those of the result.
    """
    feet = torch.einsum("...kc,k->...c", landmarks[..., list(SOLES), :], landmarks.new_tensor(BEARING))
    apart = landmarks[..., list(TRUNK), :].mean(-2) - feet
    up = ground[:3]
    return apart - (apart @ up)[..., None] * up
