"""Real spherical harmonics up to degree 3: view-dependent colours in the order and signs of 3DGS files.

Basis after Sloan, Efficient Spherical Harmonic Evaluation, JCGT 2(2), 2013; the colour is max(0, sum + 0.5) (gsplat).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ahoy_core.splat._jit import kernel
from ahoy_core.splat._threads import run_spans, split

C0 = 0.28209479177387814
C1 = 0.4886025119029199
C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
C3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)


@kernel
def _basis(x: float, y: float, z: float) -> tuple[float, ...]:
    """The sixteen functions at a unit direction."""
    xx, yy, zz = x * x, y * y, z * z
    return (
        C0, -C1 * y, C1 * z, -C1 * x,
        C2[0] * x * y, -C2[0] * y * z, C2[1] * (3.0 * zz - 1.0), -C2[0] * x * z, C2[2] * (xx - yy),
        -C3[0] * y * (3.0 * xx - yy), C3[1] * x * y * z, -C3[2] * y * (5.0 * zz - 1.0), C3[3] * z * (5.0 * zz - 3.0),
        -C3[2] * x * (5.0 * zz - 1.0), C3[4] * z * (xx - yy), -C3[0] * x * (xx - 3.0 * yy),
    )  # fmt: skip


@kernel
def _basis_gradient(x: float, y: float, z: float, g: Any) -> tuple[float, float, float]:
    """Gradient of sum_k g[k] basis_k at a unit direction, before it is made tangential."""
    xx, yy, zz = x * x, y * y, z * z
    vx, vy, vz = -C1 * g[3], -C1 * g[1], C1 * g[2]
    vx += C2[0] * (y * g[4] - z * g[7]) + 2.0 * C2[2] * x * g[8]
    vy += C2[0] * (x * g[4] - z * g[5]) - 2.0 * C2[2] * y * g[8]
    vz += 6.0 * C2[1] * z * g[6] - C2[0] * (y * g[5] + x * g[7])
    vx += -6.0 * C3[0] * x * y * g[9] + C3[1] * y * z * g[10] - C3[2] * (5.0 * zz - 1.0) * g[13]
    vx += 2.0 * C3[4] * x * z * g[14] - 3.0 * C3[0] * (xx - yy) * g[15]
    vy += -3.0 * C3[0] * (xx - yy) * g[9] + C3[1] * x * z * g[10] - C3[2] * (5.0 * zz - 1.0) * g[11]
    vy += -2.0 * C3[4] * y * z * g[14] + 6.0 * C3[0] * x * y * g[15]
    vz += C3[1] * x * y * g[10] - 10.0 * C3[2] * z * (y * g[11] + x * g[13]) + C3[3] * (15.0 * zz - 3.0) * g[12]
    vz += C3[4] * (xx - yy) * g[14]
    return vx, vy, vz


@kernel
def _direction(means: Any, i: int, center: Any) -> tuple[float, float, float, float]:
    """Unit direction from the camera's centre to a mean, and 1 / distance (all 0 at the centre itself)."""
    x, y, z = float(means[i, 0]) - center[0], float(means[i, 1]) - center[1], float(means[i, 2]) - center[2]
    square = x * x + y * y + z * z
    inverse = 1.0 / math.sqrt(square) if square > 0.0 else 0.0
    return x * inverse, y * inverse, z * inverse, inverse


@kernel
def _sh_forward(
    start: int, stop: int, terms: int, means: Any, center: Any, coefficients: Any, radii: Any, colors: Any
) -> None:
    """Colours [N,3] of the visible rows; 0 for the others."""
    for i in range(start, stop):
        for channel in range(3):
            colors[i, channel] = 0.0
        if radii[i, 0] <= 0:
            continue
        x, y, z, _ = _direction(means, i, center)
        basis = _basis(x, y, z)
        for channel in range(3):
            total = 0.5
            for k in range(terms):
                total += basis[k] * coefficients[i, k, channel]
            colors[i, channel] = max(total, 0.0)


@kernel
def _sh_backward(
    start: int, stop: int, terms: int, means: Any, center: Any, coefficients: Any, radii: Any, colors: Any,
    v_colors: Any, v_means: Any, v_coefficients: Any, v_center: Any,
) -> None:  # fmt: skip
    """Add the gradients of the visible rows; a channel clamped to 0 carries none."""
    g = np.zeros(16)
    for i in range(start, stop):
        if radii[i, 0] <= 0:
            continue
        x, y, z, inverse = _direction(means, i, center)
        basis = _basis(x, y, z)
        for k in range(terms):
            g[k] = 0.0
            for channel in range(3):
                value = float(v_colors[i, channel]) if colors[i, channel] > 0.0 else 0.0
                v_coefficients[i, k, channel] += basis[k] * value
                g[k] += value * coefficients[i, k, channel]
        vx, vy, vz = _basis_gradient(x, y, z, g)
        along = vx * x + vy * y + vz * z
        v = ((vx - along * x) * inverse, (vy - along * y) * inverse, (vz - along * z) * inverse)
        for k in range(3):
            v_means[i, k] += v[k]
            v_center[k] -= v[k]


class _SphericalHarmonics(torch.autograd.Function):
    """Colours [C,N,3] of means [N,3] seen from centers [C,3]."""

    @staticmethod
    def forward(
        ctx: Any, means: Tensor, centers: Tensor, coefficients: Tensor, radii: Tensor, degree: int, threads: int
    ) -> Tensor:
        cameras, count = radii.shape[:2]
        colors = coefficients.new_empty(cameras, count, 3)
        terms, spans = (degree + 1) ** 2, split(count, threads)
        x, middle, own, seen, out = (t.detach().numpy() for t in (means, centers, coefficients, radii, colors))
        for c in range(cameras):
            run_spans(_sh_forward, spans, terms, x, middle[c], own if own.ndim == 3 else own[c], seen[c], out[c])
        ctx.save_for_backward(means, centers, coefficients, radii, colors)
        ctx.terms, ctx.spans = terms, spans
        return colors

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_colors: Tensor) -> tuple[Any, ...]:
        means, _, coefficients, _, _ = ctx.saved_tensors
        v_means, v_coefficients = torch.zeros_like(means), torch.zeros_like(coefficients)
        x, middle, own, seen, out = (t.detach().numpy() for t in ctx.saved_tensors)
        v, vx, v_own = (t.detach().numpy() for t in (v_colors.contiguous(), v_means, v_coefficients))
        v_centers = np.zeros((len(ctx.spans), *middle.shape))
        for c in range(len(middle)):
            shared = [a if a.ndim == 3 else a[c] for a in (own, v_own)]
            arrays = (x, middle[c], shared[0], seen[c], out[c], v[c], vx, shared[1])
            run_spans(_sh_backward, ctx.spans, ctx.terms, *arrays, each=v_centers[:, c])
        return v_means, torch.from_numpy(v_centers.sum(0)), v_coefficients, None, None, None


def sh_to_colors(
    means: Tensor, viewmats: Tensor, coefficients: Tensor, radii: Tensor, degree: int, threads: int = 1
) -> Tensor:
    """Colours of Gaussians as the cameras see them: max(0, sum_k basis_k(direction) coefficient_k + 0.5).

    Args:
        means: [N,3] world, metres.
        viewmats: [C,4,4] world -> camera.
        coefficients: [N,K,3] or [C,N,K,3] with K >= (degree + 1)^2; higher bands are ignored.
        radii: [C,N,2]; rows with radius 0 are not visible: they get colour 0 and no gradient.
        degree: 0 to 3.
        threads: Threads to use.

    Returns:
        [C,N,3] in the dtype of the coefficients.
    """
    centers = torch.linalg.inv(viewmats.double())[:, :3, 3].contiguous()
    return _SphericalHarmonics.apply(means.contiguous(), centers, coefficients.contiguous(), radii, degree, threads)
