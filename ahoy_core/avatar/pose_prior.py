"""Poses kept near those of training: PCA projection at inference (paper section 3.4, after Animatable Gaussians)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ahoy_core.body.rotations import nearest_rotation, so3_exp, so3_log

# Singular values below this share of the largest are round-off, not directions in which the training poses vary.
_RANK_TOLERANCE = 1e-4


@dataclass(frozen=True)
class PosePrior:
    """The training poses as a mean and the directions in which they vary; the root is left out.

    Attributes:
        mean: [D] mean of the flattened rotation matrices, D = 9 (J - 1).
        axes: [K,D] orthonormal; K is at most the number of training poses less one, 0 for a single pose.
        low: [K] least coefficient of a training pose along each axis.
        high: [K] largest coefficient.
    """

    mean: Tensor
    axes: Tensor
    low: Tensor
    high: Tensor

    @classmethod
    def of(cls, rotations: Tensor, components: int = 16) -> PosePrior:
        """The distribution of training poses.

        Args:
            rotations: [T,J,3,3] local rotations, T at least 1; any rank.
            components: Largest number of axes kept.

        Raises:
            ValueError: If there is no pose, or one is not finite.
        """
        if len(rotations) == 0 or not bool(torch.isfinite(rotations).all()):
            raise ValueError(f"expected at least one finite training pose, got {len(rotations)}; train on some frames")
        rows = rotations[:, 1:].double().flatten(1)
        mean = rows.mean(0)
        _, sizes, axes = torch.linalg.svd(rows - mean, full_matrices=False)
        keep = int((sizes > _RANK_TOLERANCE * max(float(sizes[0]), 1e-6)).sum()) if len(rows) > 1 else 0
        axes = axes[: min(keep, components)]
        along = (rows - mean) @ axes.T
        return cls(mean, axes, along.amin(0), along.amax(0))

    def project(self, rotations: Tensor, strength: float = 1.0) -> Tensor:
        """Move a pose towards the training poses.

        Its coefficients along the axes are clamped to the training range; what is off the axes is dropped; the nearest
        rotations are taken; and of the way from the pose to there, `strength` is gone.

        Args:
            rotations: [J,3,3] local rotations; the root's is returned as it is.
            strength: 0 leaves the pose, 1 projects it.

        Returns:
            [J,3,3].

        Raises:
            ValueError: If strength is outside [0,1].
        """
        if not 0 <= strength <= 1:
            raise ValueError(f"expected a strength in [0,1], got {strength}")
        if strength == 0:
            return rotations
        row = rotations[1:].double().flatten() - self.mean
        along = (self.axes @ row).clamp(self.low, self.high)
        inside = nearest_rotation((self.mean + along @ self.axes).reshape(-1, 3, 3)).to(rotations)
        if strength < 1:
            own = rotations[1:]
            inside = own @ so3_exp(strength * so3_log(own.transpose(-1, -2) @ inside))
        return torch.cat([rotations[:1], inside])
