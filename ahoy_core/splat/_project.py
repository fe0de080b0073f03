"""Projection of 3D Gaussians to the image plane (Zwicker et al. 2001, EWA splatting), one camera at a time.

Arithmetic is float64 whatever the arrays hold: a world shifted by 1e6 m then loses nothing, and it costs little because
blending dominates. The 2D covariance is factored as Sigma = B B^T with B = J R_cam R S [2,3], rows u and v, and its
determinant taken as |u x v|^2 + eps (|u|^2 + |v|^2) + eps^2: a sum of squares, exact even for needles of 1e8 : 1.

Blending reads the inverse covariance through factors (a, b, c) with
    KAPPA d^T Sigma^-1 d = (a dx + b dy)^2 + (c dy)^2,
which cannot turn negative and loses only half the digits that the expanded quadratic loses on needles.
"""

from __future__ import annotations

import math
from typing import Any

from ahoy_core.splat import _camera as cam
from ahoy_core.splat._jit import kernel
from ahoy_core.splat.constants import KAPPA, TINY

Scalars = tuple[float, ...]


@kernel
def to_camera(camera: Any, x: float, y: float, z: float) -> Scalars:
    """World -> camera coordinates."""
    return (
        camera[0] * x + camera[1] * y + camera[2] * z + camera[9],
        camera[3] * x + camera[4] * y + camera[5] * z + camera[10],
        camera[6] * x + camera[7] * y + camera[8] * z + camera[11],
    )


@kernel
def jacobian(camera: Any, x: float, y: float, z: float) -> Scalars:
    """Rows (j0, 0, j2) and (0, k1, k2) of the projection's Jacobian, clamped in the frustum's margin as gsplat does."""
    fx, fy = camera[cam.FX], camera[cam.FY]
    if camera[cam.ORTHO] != 0.0:
        return fx, 0.0, fy, 0.0
    rz = 1.0 / z
    u = min(max(x * rz, camera[cam.X_MIN]), camera[cam.X_MAX])
    v = min(max(y * rz, camera[cam.Y_MIN]), camera[cam.Y_MAX])
    return fx * rz, -fx * u * rz, fy * rz, -fy * v * rz


@kernel
def mean_to_image(camera: Any, x: float, y: float, z: float) -> tuple[float, float]:
    """Camera coordinates -> pixels."""
    rz = 1.0 if camera[cam.ORTHO] != 0.0 else 1.0 / z
    return camera[cam.FX] * x * rz + camera[cam.CX], camera[cam.FY] * y * rz + camera[cam.CY]


@kernel
def world_rows(camera: Any, j0: float, j2: float, k1: float, k2: float) -> Scalars:
    """The two rows of J R_cam: the image-plane derivative with respect to the world."""
    return (
        j0 * camera[0] + j2 * camera[6], j0 * camera[1] + j2 * camera[7], j0 * camera[2] + j2 * camera[8],
        k1 * camera[3] + k2 * camera[6], k1 * camera[4] + k2 * camera[7], k1 * camera[5] + k2 * camera[8],
    )  # fmt: skip


@kernel
def rotation(w: float, x: float, y: float, z: float) -> Scalars:
    """Row-major rotation of a quaternion of any length; zero is the identity."""
    square = w * w + x * x + y * y + z * z
    if not square > 0.0:
        return 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0
    inverse = 1.0 / math.sqrt(square)
    w, x, y, z = w * inverse, x * inverse, y * inverse, z * inverse
    return (
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
        2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y),
    )  # fmt: skip


@kernel
def half_covariance(rows: Scalars, R: Scalars, sx: float, sy: float, sz: float) -> Scalars:
    """B = (J R_cam) R S: its rows u and v."""
    a, b, c, d, e, f = rows
    return (
        (a * R[0] + b * R[3] + c * R[6]) * sx, (a * R[1] + b * R[4] + c * R[7]) * sy,
        (a * R[2] + b * R[5] + c * R[8]) * sz, (d * R[0] + e * R[3] + f * R[6]) * sx,
        (d * R[1] + e * R[4] + f * R[7]) * sy, (d * R[2] + e * R[5] + f * R[8]) * sz,
    )  # fmt: skip


@kernel
def covariance_of_half(B: Scalars) -> Scalars:
    """Sigma = B B^T as xx, xy, yy and its determinant, a sum of squares (Lagrange's identity)."""
    u0, u1, u2, v0, v1, v2 = B
    p, q, r = u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0
    return u0 * u0 + u1 * u1 + u2 * u2, u0 * v0 + u1 * v1 + u2 * v2, v0 * v0 + v1 * v1 + v2 * v2, p * p + q * q + r * r


@kernel
def symmetric(covars: Any, i: int) -> Scalars:
    """The symmetric part of covars[i]: xx, xy, xz, yy, yz, zz."""
    return (
        float(covars[i, 0, 0]), 0.5 * (float(covars[i, 0, 1]) + float(covars[i, 1, 0])),
        0.5 * (float(covars[i, 0, 2]) + float(covars[i, 2, 0])), float(covars[i, 1, 1]),
        0.5 * (float(covars[i, 1, 2]) + float(covars[i, 2, 1])), float(covars[i, 2, 2]),
    )  # fmt: skip


@kernel
def covariance_of_full(rows: Scalars, S: Scalars) -> Scalars:
    """Sigma = T S T^T for the rows T of `world_rows`, as xx, xy, yy and determinant."""
    a, b, c, d, e, f = rows
    p, q, r = S[0] * a + S[1] * b + S[2] * c, S[1] * a + S[3] * b + S[4] * c, S[2] * a + S[4] * b + S[5] * c
    s, t, w = S[0] * d + S[1] * e + S[2] * f, S[1] * d + S[3] * e + S[4] * f, S[2] * d + S[4] * e + S[5] * f
    xx, xy, yy = a * p + b * q + c * r, d * p + e * q + f * r, d * s + e * t + f * w
    return xx, xy, yy, max(xx * yy - xy * xy, 0.0)


@kernel
def row_is_finite(means: Any, quats: Any, scales: Any, covars: Any, opacity: float, features: Any, i: int) -> bool:
    """Whether nothing that belongs to Gaussian i is NaN or infinite (x - x is 0 for finite x only)."""
    total = float(opacity)
    for k in range(3):
        total += float(means[i, k])
    if covars.shape[0] > 0:
        for k in range(9):
            total += float(covars[i, k // 3, k % 3])
    else:
        for k in range(3):
            total += float(scales[i, k]) + float(quats[i, k])
        total += float(quats[i, 3])
    for k in range(features.shape[1]):
        total += float(features[i, k])
    return total - total == 0.0


@kernel
def project_one(camera: Any, means: Any, quats: Any, scales: Any, covars: Any, i: int) -> Scalars:
    """Camera z, image mean (2) and covariance without blur (xx, xy, yy, det); det is -inf beyond the planes."""
    x, y, z = to_camera(camera, float(means[i, 0]), float(means[i, 1]), float(means[i, 2]))
    if not (camera[cam.NEAR] < z < camera[cam.FAR]):
        return z, 0.0, 0.0, 0.0, 0.0, 0.0, -math.inf
    j0, j2, k1, k2 = jacobian(camera, x, y, z)
    rows = world_rows(camera, j0, j2, k1, k2)
    if covars.shape[0] > 0:
        xx, xy, yy, det = covariance_of_full(rows, symmetric(covars, i))
    else:
        R = rotation(float(quats[i, 0]), float(quats[i, 1]), float(quats[i, 2]), float(quats[i, 3]))
        B = half_covariance(rows, R, float(scales[i, 0]), float(scales[i, 1]), float(scales[i, 2]))
        xx, xy, yy, det = covariance_of_half(B)
    mx, my = mean_to_image(camera, x, y, z)
    return z, mx, my, xx, xy, yy, det


@kernel
def reach(camera: Any, opacity: float, mx: float, my: float, xx: float, yy: float) -> tuple[float, float]:
    """Half extents in pixels of the region where alpha can pass the cutoff; (0, 0) if that misses the image."""
    if not opacity > 0.0:
        return 0.0, 0.0
    exponent = math.log2(opacity) - camera[cam.LOG2_CUTOFF]
    if not exponent >= 0.0:
        return 0.0, 0.0
    sigmas = math.sqrt(exponent / KAPPA)
    rx, ry = sigmas * math.sqrt(xx), sigmas * math.sqrt(yy)
    if max(math.ceil(rx), math.ceil(ry)) <= camera[cam.RADIUS_CLIP]:
        return 0.0, 0.0
    inside_x = mx + rx > 0.0 and mx - rx < camera[cam.WIDTH]
    inside_y = my + ry > 0.0 and my - ry < camera[cam.HEIGHT]
    return (rx, ry) if inside_x and inside_y else (0.0, 0.0)


@kernel
def project_forward(
    start: int, stop: int, camera: Any, antialiased: bool, means: Any, quats: Any, scales: Any, covars: Any,
    opacities: Any, features: Any, radii: Any, means2d: Any, residuals: Any, depths: Any, conics: Any, factors: Any,
    compensations: Any, order_keys: Any, invalid: Any,
) -> int:  # fmt: skip
    """Fill rows [start, stop); rows that are not visible get zeros. Returns a row with a negative scale, or -1.

    residuals hold what rounding took from means2d; order_keys the depth in float64, by which Gaussians are sorted.
    """
    negative = -1
    for i in range(start, stop):
        radii[i, 0], radii[i, 1], means2d[i, 0], means2d[i, 1], depths[i] = 0, 0, 0.0, 0.0, 0.0
        for k in range(3):
            conics[i, k], factors[i, k] = 0.0, 0.0
        if antialiased:
            compensations[i] = 0.0
        if not row_is_finite(means, quats, scales, covars, opacities[i], features, i):
            invalid[i] = 1
            continue
        if covars.shape[0] == 0 and min(scales[i, 0], scales[i, 1], scales[i, 2]) < 0.0:
            negative = i
            continue
        z, mx, my, xx, xy, yy, sharp = project_one(camera, means, quats, scales, covars, i)
        blur = camera[cam.EPS2D]
        det = sharp + blur * (xx + yy) + blur * blur
        if not (0.0 < det < math.inf):
            continue
        xx, yy = xx + blur, yy + blur
        compensation = math.sqrt(sharp / det) if antialiased else 1.0
        rx, ry = reach(camera, float(opacities[i]) * compensation, mx, my, xx, yy)
        if not rx > 0.0:
            continue
        if antialiased:
            compensations[i] = compensation
        radii[i, 0], radii[i, 1] = int(min(math.ceil(rx), 2.0**30)), int(min(math.ceil(ry), 2.0**30))
        means2d[i, 0], means2d[i, 1], depths[i], order_keys[i] = mx, my, z, z
        residuals[i, 0], residuals[i, 1] = mx - float(means2d[i, 0]), my - float(means2d[i, 1])
        conics[i, 0], conics[i, 1], conics[i, 2] = yy / det, -xy / det, xx / det
        a = max(math.sqrt(KAPPA * yy / det), TINY)
        factors[i, 0], factors[i, 1], factors[i, 2] = a, -a * xy / yy, max(math.sqrt(KAPPA / yy), TINY)
    return negative
