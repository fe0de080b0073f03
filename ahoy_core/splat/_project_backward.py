"""Reverse of `_project`: gradients of image-plane quantities back to Gaussians and camera pose, in float64."""

from __future__ import annotations

import math
from typing import Any

from ahoy_core.splat import _camera as cam
from ahoy_core.splat._jit import kernel
from ahoy_core.splat._project import (
    Scalars,
    covariance_of_full,
    covariance_of_half,
    half_covariance,
    jacobian,
    rotation,
    symmetric,
    to_camera,
    world_rows,
)
from ahoy_core.splat.constants import KAPPA


@kernel
def from_factors(a: float, xx: float, xy: float, yy: float, det: float, va: float, vb: float, vc: float) -> Scalars:
    """Gradient of the blurred covariance (xx, xy, yy) from that of the factors a, b = -a xy / yy, c = sqrt(KAPPA / yy).

    d det = yy dxx + xx dyy - 2 xy dxy is folded in, which leaves no difference of large numbers for needles.
    """
    inner = va - vb * xy / yy
    v_xx = -0.5 * inner * a * yy / det
    v_xy = inner * a * xy / det - vb * a / yy
    v_yy = -0.5 * inner * a * xy * xy / (yy * det) + vb * a * xy / (yy * yy) - 0.5 * vc * math.sqrt(KAPPA / yy) / yy
    return v_xx, v_xy, v_yy


@kernel
def from_conics(xx: float, xy: float, yy: float, det: float, va: float, vb: float, vc: float) -> Scalars:
    """Gradient of the blurred covariance from that of its inverse (yy, -xy, xx) / det."""
    v_det = -(yy * va - xy * vb + xx * vc) / (det * det)
    return vc / det + v_det * yy, -vb / det - 2.0 * v_det * xy, va / det + v_det * xx


@kernel
def from_compensation(blur: float, xx: float, xy: float, yy: float, sharp: float, det: float, v: float) -> Scalars:
    """Gradient of the covariance from that of sqrt(sharp / det); xx and yy include the blur.

    A visible Gaussian has sharp > 0: with a zero determinant its compensated opacity is 0 and it was culled.
    """
    if not sharp > 0.0:
        return 0.0, 0.0, 0.0
    half = 0.5 * v * math.sqrt(sharp / det)
    return (
        half * ((yy - blur) / sharp - yy / det),
        -2.0 * half * xy * (1.0 / sharp - 1.0 / det),
        half * ((xx - blur) / sharp - xx / det),
    )


@kernel
def to_mean(camera: Any, x: float, y: float, z: float, v_j: Scalars, v_mx: float, v_my: float) -> Scalars:
    """Gradient of the camera-space mean from those of the Jacobian (j0, j2, k1, k2) and of the image mean."""
    fx, fy = camera[cam.FX], camera[cam.FY]
    if camera[cam.ORTHO] != 0.0:
        return fx * v_mx, fy * v_my, 0.0
    rz = 1.0 / z
    u = min(max(x * rz, camera[cam.X_MIN]), camera[cam.X_MAX])
    v = min(max(y * rz, camera[cam.Y_MIN]), camera[cam.Y_MAX])
    vx, vy = fx * rz * v_mx, fy * rz * v_my
    vz = -(fx * x * v_mx + fy * y * v_my + fx * v_j[0] + fy * v_j[2] - fx * u * v_j[1] - fy * v * v_j[3]) * rz * rz
    if u == x * rz:
        vx -= fx * rz * rz * v_j[1]
        vz += fx * u * rz * rz * v_j[1]
    if v == y * rz:
        vy -= fy * rz * rz * v_j[3]
        vz += fy * v * rz * rz * v_j[3]
    return vx, vy, vz


@kernel
def to_quaternion(w: float, x: float, y: float, z: float, G: Scalars) -> Scalars:
    """Gradient of an unnormalised quaternion from that of its rotation; a zero quaternion gets none."""
    square = w * w + x * x + y * y + z * z
    if not square > 0.0:
        return 0.0, 0.0, 0.0, 0.0
    inverse = 1.0 / math.sqrt(square)
    w, x, y, z = w * inverse, x * inverse, y * inverse, z * inverse
    vw = 2.0 * (x * (G[7] - G[5]) + y * (G[2] - G[6]) + z * (G[3] - G[1]))
    vx = 2.0 * (-2.0 * x * (G[4] + G[8]) + y * (G[1] + G[3]) + z * (G[2] + G[6]) + w * (G[7] - G[5]))
    vy = 2.0 * (x * (G[1] + G[3]) - 2.0 * y * (G[0] + G[8]) + z * (G[5] + G[7]) + w * (G[2] - G[6]))
    vz = 2.0 * (x * (G[2] + G[6]) + y * (G[5] + G[7]) - 2.0 * z * (G[0] + G[4]) + w * (G[3] - G[1]))
    along = vw * w + vx * x + vy * y + vz * z
    return (
        (vw - w * along) * inverse,
        (vx - x * along) * inverse,
        (vy - y * along) * inverse,
        (vz - z * along) * inverse,
    )


@kernel
def to_quats_and_scales(
    rows: Scalars, B: Scalars, g: Scalars, quats: Any, scales: Any, i: int, v_quats: Any, v_scales: Any
) -> Scalars:
    """Add the gradients of quaternion and scales; returns that of the rows J R_cam."""
    qw, qx, qy, qz = float(quats[i, 0]), float(quats[i, 1]), float(quats[i, 2]), float(quats[i, 3])
    sx, sy, sz = float(scales[i, 0]), float(scales[i, 1]), float(scales[i, 2])
    R = rotation(qw, qx, qy, qz)
    a, b, c, d, e, f = rows
    u0, u1, u2 = 2.0 * g[0] * B[0] + g[1] * B[3], 2.0 * g[0] * B[1] + g[1] * B[4], 2.0 * g[0] * B[2] + g[1] * B[5]
    v0, v1, v2 = 2.0 * g[2] * B[3] + g[1] * B[0], 2.0 * g[2] * B[4] + g[1] * B[1], 2.0 * g[2] * B[5] + g[1] * B[2]
    m0, m1, m2 = a * u0 + d * v0, a * u1 + d * v1, a * u2 + d * v2
    m3, m4, m5 = b * u0 + e * v0, b * u1 + e * v1, b * u2 + e * v2
    m6, m7, m8 = c * u0 + f * v0, c * u1 + f * v1, c * u2 + f * v2
    v_scales[i, 0] += m0 * R[0] + m3 * R[3] + m6 * R[6]
    v_scales[i, 1] += m1 * R[1] + m4 * R[4] + m7 * R[7]
    v_scales[i, 2] += m2 * R[2] + m5 * R[5] + m8 * R[8]
    G = (m0 * sx, m1 * sy, m2 * sz, m3 * sx, m4 * sy, m5 * sz, m6 * sx, m7 * sy, m8 * sz)
    vq = to_quaternion(qw, qx, qy, qz, G)
    for k in range(4):
        v_quats[i, k] += vq[k]
    u0, u1, u2, v0, v1, v2 = u0 * sx, u1 * sy, u2 * sz, v0 * sx, v1 * sy, v2 * sz
    return (
        u0 * R[0] + u1 * R[1] + u2 * R[2], u0 * R[3] + u1 * R[4] + u2 * R[5], u0 * R[6] + u1 * R[7] + u2 * R[8],
        v0 * R[0] + v1 * R[1] + v2 * R[2], v0 * R[3] + v1 * R[4] + v2 * R[5], v0 * R[6] + v1 * R[7] + v2 * R[8],
    )  # fmt: skip


@kernel
def to_covars(rows: Scalars, S: Scalars, g: Scalars, i: int, v_covars: Any) -> Scalars:
    """Add T^T G T to the gradient of the covariance (symmetric); returns that of the rows T = J R_cam, 2 G T S."""
    a, b, c, d, e, f = rows
    half = 0.5 * g[1]
    p, q, r = g[0] * a + half * d, g[0] * b + half * e, g[0] * c + half * f
    s, t, w = half * a + g[2] * d, half * b + g[2] * e, half * c + g[2] * f
    xy, xz, yz = a * q + d * t, a * r + d * w, b * r + e * w
    v_covars[i, 0, 0] += a * p + d * s
    v_covars[i, 1, 1] += b * q + e * t
    v_covars[i, 2, 2] += c * r + f * w
    v_covars[i, 0, 1] += xy
    v_covars[i, 1, 0] += xy
    v_covars[i, 0, 2] += xz
    v_covars[i, 2, 0] += xz
    v_covars[i, 1, 2] += yz
    v_covars[i, 2, 1] += yz
    return (
        2.0 * (p * S[0] + q * S[1] + r * S[2]), 2.0 * (p * S[1] + q * S[3] + r * S[4]),
        2.0 * (p * S[2] + q * S[4] + r * S[5]), 2.0 * (s * S[0] + t * S[1] + w * S[2]),
        2.0 * (s * S[1] + t * S[3] + w * S[4]), 2.0 * (s * S[2] + t * S[4] + w * S[5]),
    )  # fmt: skip


@kernel
def add_pose(pose: Any, v_rows: Scalars, j: Scalars, v_t: Scalars, x: float, y: float, z: float) -> None:
    """Add the gradient of one Gaussian to that of [R | t], 12 values: through J R_cam and through R_cam mean + t."""
    j0, j2, k1, k2 = j
    world = (x, y, z)
    for k in range(3):
        pose[k] += j0 * v_rows[k] + v_t[0] * world[k]
        pose[3 + k] += k1 * v_rows[3 + k] + v_t[1] * world[k]
        pose[6 + k] += j2 * v_rows[k] + k2 * v_rows[3 + k] + v_t[2] * world[k]
        pose[9 + k] += v_t[k]


@kernel
def covariance_gradient(
    camera: Any, i: int, xx: float, xy: float, yy: float, sharp: float, v_factors: Any, v_conics: Any, v_comps: Any
) -> Scalars:
    """Sum of all that reaches the blurred covariance (xx, xy, yy); arrays without rows carry no gradient."""
    blur = camera[cam.EPS2D]
    det = sharp + blur * (xx + yy) + blur * blur
    xx, yy = xx + blur, yy + blur
    g0, g1, g2 = 0.0, 0.0, 0.0
    if v_factors.shape[0] > 0:
        a = math.sqrt(KAPPA * yy / det)
        va, vb, vc = float(v_factors[i, 0]), float(v_factors[i, 1]), float(v_factors[i, 2])
        g0, g1, g2 = from_factors(a, xx, xy, yy, det, va, vb, vc)
    if v_conics.shape[0] > 0:
        va, vb, vc = float(v_conics[i, 0]), float(v_conics[i, 1]), float(v_conics[i, 2])
        h0, h1, h2 = from_conics(xx, xy, yy, det, va, vb, vc)
        g0, g1, g2 = g0 + h0, g1 + h1, g2 + h2
    if v_comps.shape[0] > 0:
        h0, h1, h2 = from_compensation(blur, xx, xy, yy, sharp, det, float(v_comps[i]))
        g0, g1, g2 = g0 + h0, g1 + h1, g2 + h2
    return g0, g1, g2


@kernel
def project_backward(
    start: int, stop: int, camera: Any, means: Any, quats: Any, scales: Any, covars: Any, radii: Any,
    v_means2d: Any, v_depths: Any, v_conics: Any, v_factors: Any, v_comps: Any,
    v_means: Any, v_quats: Any, v_scales: Any, v_covars: Any, pose: Any,
) -> None:  # fmt: skip
    """Add one camera's gradients of rows [start, stop) to the v_ arrays and to pose [12]; unseen rows are skipped."""
    for i in range(start, stop):
        if radii[i, 0] <= 0:
            continue
        wx, wy, wz = float(means[i, 0]), float(means[i, 1]), float(means[i, 2])
        x, y, z = to_camera(camera, wx, wy, wz)
        j = jacobian(camera, x, y, z)
        rows = world_rows(camera, j[0], j[1], j[2], j[3])
        if covars.shape[0] > 0:
            S = symmetric(covars, i)
            xx, xy, yy, sharp = covariance_of_full(rows, S)
            g = covariance_gradient(camera, i, xx, xy, yy, sharp, v_factors, v_conics, v_comps)
            v_rows = to_covars(rows, S, g, i, v_covars)
        else:
            R = rotation(float(quats[i, 0]), float(quats[i, 1]), float(quats[i, 2]), float(quats[i, 3]))
            B = half_covariance(rows, R, float(scales[i, 0]), float(scales[i, 1]), float(scales[i, 2]))
            xx, xy, yy, sharp = covariance_of_half(B)
            g = covariance_gradient(camera, i, xx, xy, yy, sharp, v_factors, v_conics, v_comps)
            v_rows = to_quats_and_scales(rows, B, g, quats, scales, i, v_quats, v_scales)
        v_j = (
            v_rows[0] * camera[0] + v_rows[1] * camera[1] + v_rows[2] * camera[2],
            v_rows[0] * camera[6] + v_rows[1] * camera[7] + v_rows[2] * camera[8],
            v_rows[3] * camera[3] + v_rows[4] * camera[4] + v_rows[5] * camera[5],
            v_rows[3] * camera[6] + v_rows[4] * camera[7] + v_rows[5] * camera[8],
        )
        v_mx = float(v_means2d[i, 0]) if v_means2d.shape[0] > 0 else 0.0
        v_my = float(v_means2d[i, 1]) if v_means2d.shape[0] > 0 else 0.0
        vx, vy, vz = to_mean(camera, x, y, z, v_j, v_mx, v_my)
        if v_depths.shape[0] > 0:
            vz += float(v_depths[i])
        for k in range(3):
            v_means[i, k] += camera[k] * vx + camera[3 + k] * vy + camera[6 + k] * vz
        add_pose(pose, v_rows, j, (vx, vy, vz), wx, wy, wz)
