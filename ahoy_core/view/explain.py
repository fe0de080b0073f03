"""Colours that explain an avatar, and which source frame a Gaussian came from."""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ahoy_core.avatar.avatar import Avatar

Mode = Literal["colour", "coverage", "observed", "opacity"]
MODES: tuple[Mode, ...] = ("colour", "coverage", "observed", "opacity")
# Invented and observed in colours that people who see red and green alike can tell apart.
_INVENTED, _OBSERVED = (0.84, 0.37, 0.0), (0.0, 0.45, 0.70)


def explained_colors(avatar: Avatar, mode: Mode) -> Tensor:
    """Colours [N,3] of an avatar's Gaussians in one of the modes.

    Args:
        avatar: Whose.
        mode: "colour" as it is; "coverage" from invented (orange) to well observed (blue); "observed" the same in two
            steps; "opacity" from transparent (dark) to solid (light).
    """
    if mode == "colour":
        return avatar.colors
    if mode == "opacity":
        return avatar.opacities[:, None].expand(-1, 3)
    share = avatar.observed if mode == "coverage" else (avatar.observed >= 0.5).float()
    low, high = (torch.tensor(color) for color in (_INVENTED, _OBSERVED))
    return low + share.clamp(0, 1)[:, None] * (high - low)


def nearest_hit(means: Tensor, covars: Tensor, opacities: Tensor, origin: Tensor, direction: Tensor) -> int | None:
    """The Gaussian that a ray meets first: the nearest of those whose density on the ray is above half of their peak.

    Args:
        means: [N,3].
        covars: [N,3,3].
        opacities: [N]; nearly transparent ones are not met.
        origin: [3].
        direction: [3], any length.

    Returns:
        Its number, or None if the ray meets nothing.
    """
    ray = torch.nn.functional.normalize(direction, dim=0)
    inverse = torch.linalg.inv(covars + 1e-9 * torch.eye(3))
    offset = means - origin
    # Along o + t d the Mahalanobis distance is a parabola; its lowest point is where the Gaussian is densest.
    curve = torch.einsum("i,nij,j->n", ray, inverse, ray)
    slope = torch.einsum("i,nij,nj->n", ray, inverse, offset)
    depth = slope / curve
    least = torch.einsum("ni,nij,nj->n", offset, inverse, offset) - slope * depth
    met = (least < 2 * np.log(2)) & (depth > 0) & (opacities > 0.2)
    if not bool(met.any()):
        return None
    return int(torch.where(met, depth, torch.inf).argmin())


def source_frame(avatar: Avatar, number: int, frames: NDArray[np.int32]) -> int | None:
    """The frame of the video that a Gaussian's texture came from.

    Args:
        avatar: Whose.
        number: Of the Gaussian.
        frames: [A,A] `source_frame` of the texture stage, -1 where the video showed nothing.

    Returns:
        Index into the ingested frames, or None if this part was invented.
    """
    size = len(frames)
    u, v = avatar.uv[number].tolist()
    # Texture coordinates start at the lower left, rows at the top.
    column, row = (min(size - 1, max(0, int(c * size))) for c in (u, 1 - v))
    found = int(frames[row, column])
    return found if found >= 0 else None
