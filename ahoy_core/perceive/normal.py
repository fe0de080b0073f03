"""Least squares over a clip: each frame touches itself and two neighbours, a few numbers touch every frame.

The normal matrix is a band of [P,P] blocks with a border of G columns. The band is factored by LAPACK, the border by
a Schur complement: time grows linearly with the number of frames.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_solve_banded, cholesky_banded
from torch import Tensor

REACH = 3  # blocks a row: a frame and the two after it


@dataclass(frozen=True)
class Normal:
    """Normal equations, filled in place by `add_rows`.

    Attributes:
        blocks: three tensors [N,P,P]: frame t with itself, with t+1 and with t+2.
        border: [N,P,G].
        corner: [G,G].
        gradient: [N,P].
        clip_gradient: [G].
    """

    blocks: tuple[Tensor, Tensor, Tensor]
    border: Tensor
    corner: Tensor
    gradient: Tensor
    clip_gradient: Tensor


def empty_normal(frames: int, per_frame: int, per_clip: int) -> Normal:
    """All zeros, float64."""

    def zeros(*shape: int) -> Tensor:
        return torch.zeros(*shape, dtype=torch.float64)

    square = (frames, per_frame, per_frame)
    return Normal(
        (zeros(*square), zeros(*square), zeros(*square)),
        zeros(frames, per_frame, per_clip),
        zeros(per_clip, per_clip),
        zeros(frames, per_frame),
        zeros(per_clip),
    )


def add_rows(normal: Normal, residuals: Tensor, rows: tuple[Tensor, ...], clip_rows: Tensor, first: Tensor) -> None:
    """Add squared residuals that involve one, two or three successive frames.

    Args:
        normal: filled in place.
        residuals: [M,R].
        rows: for each of the successive frames, derivatives [M,R,P].
        clip_rows: [M,R,G].
        first: [M] the first of the frames.
    """
    for a, left in enumerate(rows):
        normal.gradient.index_add_(0, first + a, torch.einsum("mrp,mr->mp", left, residuals))
        normal.border.index_add_(0, first + a, left.transpose(1, 2) @ clip_rows)
        for b in range(a, len(rows)):
            normal.blocks[b - a].index_add_(0, first + a, left.transpose(1, 2) @ rows[b])
    normal.corner.add_(torch.einsum("mrg,mrh->gh", clip_rows, clip_rows))
    normal.clip_gradient.add_(torch.einsum("mrg,mr->g", clip_rows, residuals))


def solve(normal: Normal, damping: float) -> tuple[Tensor, Tensor] | None:
    """Solve for the Levenberg-Marquardt step.

    Args:
        normal: the equations.
        damping: share of the diagonal that is added to it.

    Returns:
        Steps [N,P] and [G], or None where the matrix is not positive definite.
    """
    n, p = normal.gradient.shape
    g = len(normal.clip_gradient)
    band = _band(normal)
    band[0] += damping * band[0] + 1e-9
    try:
        factor = cholesky_banded(band, lower=True, check_finite=False)
    except LinAlgError:
        return None
    right = torch.cat([normal.gradient[..., None], normal.border], dim=2).reshape(n * p, 1 + g).numpy()
    solved = torch.from_numpy(cho_solve_banded((factor, True), right, check_finite=False))
    border = normal.border.reshape(n * p, g)
    corner = normal.corner + torch.diag(damping * normal.corner.diagonal() + 1e-9)
    schur = corner - border.T @ solved[:, 1:]
    clip = torch.linalg.lstsq(schur, (normal.clip_gradient - border.T @ solved[:, 0])[:, None]).solution[:, 0]
    frames = solved[:, 0] - solved[:, 1:] @ clip
    return -frames.reshape(n, p), -clip


def _band(normal: Normal) -> NDArray[np.float64]:
    """Lower band storage [REACH * P, N * P] of the blocks: entry (i - j, j)."""
    n, p = normal.gradient.shape
    band = np.zeros((REACH * p, n * p))
    row, column = np.meshgrid(np.arange(p), np.arange(p), indexing="ij")
    for distance, block in enumerate(normal.blocks):
        # The stored block is (t, t + distance); the band wants its transpose, below the diagonal.
        values = block.transpose(1, 2).numpy()
        offset = distance * p + row - column
        kept = offset >= 0
        for t in range(n - distance):
            band[offset[kept], t * p + column[kept]] = values[t][kept]
    return band
