"""The similarity that takes points nearest to their partners (Umeyama 1991), for rows with estimated poses."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class Similarity(NamedTuple):
    """x -> scale * rotation @ x + shift: scale [], rotation [3,3], shift [3] metres, float64."""

    scale: Tensor
    rotation: Tensor
    shift: Tensor

    def points(self, values: Tensor) -> Tensor:
        """Moved points [...,3]."""
        moved: Tensor = self.scale * values.double() @ self.rotation.T + self.shift
        return moved.to(values)

    def covariances(self, values: Tensor) -> Tensor:
        """Moved covariances [...,3,3]."""
        linear = (self.scale * self.rotation).to(values)
        moved: Tensor = linear @ values @ linear.T
        return moved


def fit_similarity(source: Tensor, target: Tensor) -> Similarity:
    """The least-squares similarity from points [N,3] to their partners [N,3], reflections left out.

    Raises:
        ValueError: Fewer than three points, values that are not finite, or points on one line: the turn about that
            line would be any.
    """
    if source.shape != target.shape or source.ndim != 2 or source.shape[1] != 3 or len(source) < 3:
        raise ValueError(f"expected two sets of >= 3 points [N,3], got {tuple(source.shape)}, {tuple(target.shape)}")
    a, b = source.double(), target.double()
    if not bool(torch.isfinite(a).all() and torch.isfinite(b).all()):
        raise ValueError("expected finite joints, got NaN or infinity; leave those frames out")
    centre_a, centre_b = a.mean(0), b.mean(0)
    a, b = a - centre_a, b - centre_b
    left, values, right = torch.linalg.svd(b.T @ a / len(a))
    if float(values[1]) <= 1e-12 * max(float(values[0]), 1e-300):
        raise ValueError("expected joints that are not all on one line, got such; no alignment is determined")
    sign = torch.ones(3, dtype=torch.float64)
    sign[2] = torch.sign(torch.linalg.det(left) * torch.linalg.det(right))
    rotation = left @ torch.diag(sign) @ right
    scale = (values * sign).sum() / a.square().sum(1).mean()
    return Similarity(scale, rotation, centre_b - scale * rotation @ centre_a)
