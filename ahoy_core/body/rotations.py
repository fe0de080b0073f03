"""Rotations: axis-angle, matrices and unit quaternions (wxyz), with finite values and gradients everywhere.

Every division by an angle goes through series near zero, and every logarithm through atan2 of a quaternion, whose
vector part never vanishes near pi. Gradients at an angle of exactly pi, where the axis flips sign, are one-sided but
finite.
"""

from __future__ import annotations

import torch
from torch import Tensor

# Below this squared angle (or squared sine) the series' error is under float64 round-off: the next term is x^3 / 5040.
_SMALL = 1e-4


def _sinc_pair(square: Tensor) -> tuple[Tensor, Tensor]:
    """sin(t)/t and (1 - cos t)/t^2 for t^2 = `square`, smooth in `square` at 0."""
    small = square < _SMALL
    angle = torch.where(small, torch.ones_like(square), square).sqrt()
    sinc = 1 - square / 6 * (1 - square / 20 * (1 - square / 42))
    versed = 0.5 * (1 - square / 12 * (1 - square / 30 * (1 - square / 56)))
    half = torch.sin(0.5 * angle) / (0.5 * angle)
    return torch.where(small, sinc, torch.sin(angle) / angle), torch.where(small, versed, 0.5 * half * half)


def skew(vectors: Tensor) -> Tensor:
    """Cross-product matrices [...,3,3] of vectors [...,3]: the matrix of a, times b, is a x b."""
    x, y, z = vectors.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).reshape(*vectors.shape[:-1], 3, 3)


def axis_angle_to_matrix(axis_angle: Tensor) -> Tensor:
    """Rodrigues' formula: axis-angle [...,3] in radians, of any length -> rotation matrices [...,3,3]."""
    sinc, versed = _sinc_pair((axis_angle * axis_angle).sum(-1))
    K = skew(axis_angle)
    eye = torch.eye(3, dtype=axis_angle.dtype, device=axis_angle.device)
    return eye + sinc[..., None, None] * K + versed[..., None, None] * (K @ K)


def axis_angle_to_quaternion(axis_angle: Tensor) -> Tensor:
    """Axis-angle [...,3] in radians -> unit quaternions wxyz [...,4]."""
    half = 0.5 * axis_angle
    square = (half * half).sum(-1, keepdim=True)
    sinc, versed = _sinc_pair(square)
    return torch.cat([1 - square * versed, sinc * half], dim=-1)


def quaternion_to_matrix(quaternions: Tensor) -> Tensor:
    """Quaternions wxyz [...,4] of any positive length -> rotation matrices [...,3,3].

    The zero quaternion has no direction: it gives the identity, with zero gradient.
    """
    square = (quaternions * quaternions).sum(-1)
    scale = torch.where(square > 0, 2.0 / torch.where(square > 0, square, torch.ones_like(square)), square)
    w, vector = quaternions[..., :1, None], quaternions[..., 1:]
    K = skew(vector)
    eye = torch.eye(3, dtype=quaternions.dtype, device=quaternions.device)
    return eye + scale[..., None, None] * (w * K + K @ K)


def matrix_to_quaternion(matrices: Tensor) -> Tensor:
    """Rotation matrices [...,3,3] -> unit quaternions wxyz [...,4] with w >= 0.

    Of the four ways to write the quaternion, the one that divides by its largest component is taken (Shepperd), so that
    no gradient is unbounded.
    """
    m = matrices
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    a, b, c = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    d, e, f = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    # Row k is 4 q_k q, for k = w, x, y, z.
    rows = torch.stack(
        [
            torch.stack([1 + xx + yy + zz, a, b, c], dim=-1),
            torch.stack([a, 1 + xx - yy - zz, d, e], dim=-1),
            torch.stack([b, d, 1 - xx + yy - zz, f], dim=-1),
            torch.stack([c, e, f, 1 - xx - yy + zz], dim=-1),
        ],
        dim=-2,
    )
    best = rows.diagonal(dim1=-2, dim2=-1).argmax(-1)
    row = rows.gather(-2, best[..., None, None].expand(*best.shape, 1, 4))[..., 0, :]
    quaternion = torch.nn.functional.normalize(row, dim=-1)
    return torch.where(quaternion[..., :1] < 0, -quaternion, quaternion)


def quaternion_to_axis_angle(quaternions: Tensor) -> Tensor:
    """Unit quaternions wxyz [...,4] -> axis-angle [...,3] with angles in [0, pi]."""
    quaternions = torch.where(quaternions[..., :1] < 0, -quaternions, quaternions)
    w, vector = quaternions[..., 0], quaternions[..., 1:]
    square = (vector * vector).sum(-1)
    small = square < _SMALL
    sine = torch.where(small, torch.ones_like(square), square).sqrt()
    # asin(s)/s = 1 + s^2/6 + 3 s^4/40 + 15 s^6/336 + ..., for the unit quaternion's sine of the half angle.
    series = 1 + square / 6 * (1 + square * 9 / 20 * (1 + square * 25 / 42))
    factor = torch.where(small, series, torch.atan2(sine, torch.where(small, torch.ones_like(w), w)) / sine)
    return 2 * factor[..., None] * vector


def matrix_to_axis_angle(matrices: Tensor) -> Tensor:
    """Rotation matrices [...,3,3] -> axis-angle [...,3] with angles in [0, pi] (the logarithm)."""
    return quaternion_to_axis_angle(matrix_to_quaternion(matrices))


def so3_exp(omega: Tensor) -> Tensor:
    """Exponential of tangent vectors [...,3] in radians; corrections are R exp(omega), never theta + delta."""
    return axis_angle_to_matrix(omega)


def so3_log(matrices: Tensor) -> Tensor:
    """Rotation matrices [...,3,3] -> tangent vectors [...,3], the inverse of `so3_exp` for angles up to pi."""
    return matrix_to_axis_angle(matrices)


def geodesic_distance(a: Tensor, b: Tensor) -> Tensor:
    """Angle [...] in [0, pi] between rotation matrices [...,3,3].

    At a distance of exactly 0, where a norm has no gradient, the gradient is 0.
    """
    omega = so3_log(a.transpose(-1, -2) @ b)
    square = (omega * omega).sum(-1)
    positive = square > 0
    return torch.where(positive, torch.where(positive, square, torch.ones_like(square)).sqrt(), square)


def nearest_rotation(matrices: Tensor) -> Tensor:
    """Nearest rotation matrices [...,3,3] in the Frobenius sense; for data from files, not for gradients (SVD)."""
    u, _, vh = torch.linalg.svd(matrices.detach())
    sign = torch.det(u @ vh)
    u = torch.cat([u[..., :2], u[..., 2:] * sign[..., None, None]], dim=-1)
    return u @ vh
