"""Projection of 3D Gaussians to the image plane (Zwicker et al. 2001, EWA splatting), sixteen Gaussians at a time.

Arithmetic is float64 whatever the arrays hold: a world shifted by 1e6 m then loses nothing, and it costs little because
blending dominates. The 2D covariance is factored as Sigma = B B^T with B = J R_cam R S [2,3], rows u and v, and its
determinant taken as |u x v|^2 + eps (|u|^2 + |v|^2) + eps^2: a sum of squares, exact even for needles of 1e8 : 1.

Blending reads the inverse covariance through factors (a, b, c) with
    KAPPA d^T Sigma^-1 d = (a dx + b dy)^2 + (c dy)^2,
which cannot turn negative and loses only half the digits that the expanded quadratic loses on needles.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np

from ahoy_core.splat import _camera as cam
from ahoy_core.splat._jit import inlined, kernel
from ahoy_core.splat._powers import log2, sqrt
from ahoy_core.splat._simd import load, maximum, minimum, select, splat, store
from ahoy_core.splat._vectors import LANES
from ahoy_core.splat.constants import KAPPA, TINY

Vecs = tuple[Any, ...]

MEAN: Final = 0  # columns of the inputs gathered for sixteen rows
OPACITY: Final = 3
SHAPE: Final = 4  # quaternion (4) and scales (3), or the symmetric covariance (6)
TOTAL: Final = 11
INPUTS: Final = 12


@inlined
def column(scratch: Any, k: int) -> Any:
    """Sixteen rows' values of one column."""
    return load(scratch, k * LANES)


@inlined
def to_camera(camera: Any, x: Any, y: Any, z: Any) -> Vecs:
    """World -> camera coordinates."""
    return (
        camera[0] * x + camera[1] * y + camera[2] * z + camera[9],
        camera[3] * x + camera[4] * y + camera[5] * z + camera[10],
        camera[6] * x + camera[7] * y + camera[8] * z + camera[11],
    )


@inlined
def jacobian(camera: Any, x: Any, y: Any, z: Any) -> Vecs:
    """Rows (j0, 0, j2) and (0, k1, k2) of the projection's Jacobian, clamped in the frustum's margin as gsplat does."""
    fx, fy, zero = splat(camera[cam.FX]), splat(camera[cam.FY]), splat(0.0)
    if camera[cam.ORTHO] != 0.0:
        return fx, zero, fy, zero
    rz = 1.0 / z
    u = minimum(maximum(x * rz, camera[cam.X_MIN]), camera[cam.X_MAX])
    v = minimum(maximum(y * rz, camera[cam.Y_MIN]), camera[cam.Y_MAX])
    j, k = fx * rz, fy * rz
    return j, -j * u, k, -k * v


@inlined
def mean_to_image(camera: Any, x: Any, y: Any, z: Any) -> Vecs:
    """Camera coordinates -> pixels."""
    rz = splat(1.0) if camera[cam.ORTHO] != 0.0 else 1.0 / z
    return camera[cam.FX] * x * rz + camera[cam.CX], camera[cam.FY] * y * rz + camera[cam.CY]


@inlined
def world_rows(camera: Any, j: Vecs) -> Vecs:
    """The two rows of J R_cam: the image-plane derivative with respect to the world."""
    j0, j2, k1, k2 = j
    return (
        j0 * camera[0] + j2 * camera[6], j0 * camera[1] + j2 * camera[7], j0 * camera[2] + j2 * camera[8],
        k1 * camera[3] + k2 * camera[6], k1 * camera[4] + k2 * camera[7], k1 * camera[5] + k2 * camera[8],
    )  # fmt: skip


@inlined
def unit_quaternion(scratch: Any) -> Vecs:
    """Normalised w, x, y, z and 1 / length; a zero quaternion becomes the identity, with 1 / length = 0."""
    w, x = column(scratch, SHAPE), column(scratch, SHAPE + 1)
    y, z = column(scratch, SHAPE + 2), column(scratch, SHAPE + 3)
    square = w * w + x * x + y * y + z * z
    usable = square > 0.0
    inverse = select(usable, 1.0 / sqrt(square), splat(0.0))
    return select(usable, w * inverse, splat(1.0)), x * inverse, y * inverse, z * inverse, inverse


@inlined
def rotation(w: Any, x: Any, y: Any, z: Any) -> Vecs:
    """Row-major rotation of a unit quaternion."""
    return (
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
        2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y),
    )  # fmt: skip


@inlined
def half_covariance(rows: Vecs, R: Vecs, sx: Any, sy: Any, sz: Any) -> Vecs:
    """B = (J R_cam) R S: its rows u and v."""
    a, b, c, d, e, f = rows
    return (
        (a * R[0] + b * R[3] + c * R[6]) * sx, (a * R[1] + b * R[4] + c * R[7]) * sy,
        (a * R[2] + b * R[5] + c * R[8]) * sz, (d * R[0] + e * R[3] + f * R[6]) * sx,
        (d * R[1] + e * R[4] + f * R[7]) * sy, (d * R[2] + e * R[5] + f * R[8]) * sz,
    )  # fmt: skip


@inlined
def covariance_of_half(B: Vecs) -> Vecs:
    """Sigma = B B^T as xx, xy, yy and its determinant, a sum of squares (Lagrange's identity)."""
    u0, u1, u2, v0, v1, v2 = B
    p, q, r = u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0
    return u0 * u0 + u1 * u1 + u2 * u2, u0 * v0 + u1 * v1 + u2 * v2, v0 * v0 + v1 * v1 + v2 * v2, p * p + q * q + r * r


@inlined
def symmetric(scratch: Any) -> Vecs:
    """The gathered covariance: xx, xy, xz, yy, yz, zz."""
    return (
        column(scratch, SHAPE), column(scratch, SHAPE + 1), column(scratch, SHAPE + 2),
        column(scratch, SHAPE + 3), column(scratch, SHAPE + 4), column(scratch, SHAPE + 5),
    )  # fmt: skip


@inlined
def covariance_of_full(rows: Vecs, S: Vecs) -> Vecs:
    """Sigma = T S T^T for the rows T of `world_rows`, as xx, xy, yy and determinant."""
    a, b, c, d, e, f = rows
    p, q, r = S[0] * a + S[1] * b + S[2] * c, S[1] * a + S[3] * b + S[4] * c, S[2] * a + S[4] * b + S[5] * c
    s, t, w = S[0] * d + S[1] * e + S[2] * f, S[1] * d + S[3] * e + S[4] * f, S[2] * d + S[4] * e + S[5] * f
    xx, xy, yy = a * p + b * q + c * r, d * p + e * q + f * r, d * s + e * t + f * w
    return xx, xy, yy, maximum(xx * yy - xy * xy, 0.0)


@kernel
def gather_inputs(
    i: int, count: int, means: Any, quats: Any, scales: Any, covars: Any, opacities: Any, scratch: Any
) -> None:
    """Columns of rows i, ..., i + count - 1; the last row fills the lanes that are left."""
    for lane in range(LANES):
        row, total = i + min(lane, count - 1), float(opacities[i + min(lane, count - 1)])
        scratch[OPACITY * LANES + lane] = total
        for k in range(3):
            scratch[(MEAN + k) * LANES + lane] = means[row, k]
            total += means[row, k]
        if covars.shape[0] > 0:
            at = SHAPE
            for k in range(3):
                for m in range(k, 3):
                    value = 0.5 * (float(covars[row, k, m]) + float(covars[row, m, k]))
                    scratch[at * LANES + lane] = value
                    total, at = total + value, at + 1
        else:
            for k in range(4):
                scratch[(SHAPE + k) * LANES + lane] = quats[row, k]
                total += quats[row, k]
            for k in range(3):
                scratch[(SHAPE + 4 + k) * LANES + lane] = scales[row, k]
                total += scales[row, k]
        scratch[TOTAL * LANES + lane] = total


@kernel
def check_rows(i: int, count: int, features: Any, scales: Any, has_scales: bool, scratch: Any, invalid: Any) -> int:
    """Mark rows that are not finite (in scratch by a NaN total); returns a row with a negative scale, or -1."""
    negative = -1
    for lane in range(count):
        total = scratch[TOTAL * LANES + lane]
        for k in range(features.shape[1]):
            total += features[i + lane, k]
        if not abs(total) < math.inf:
            invalid[i + lane] = True
            scratch[TOTAL * LANES + lane] = math.nan
        if has_scales and min(scales[i + lane, 0], scales[i + lane, 1], scales[i + lane, 2]) < 0.0:
            negative = i + lane
    return negative


@inlined
def shape_on_image(camera: Any, full: bool, scratch: Any, x: Any, y: Any, z: Any) -> Vecs:
    """Covariance without blur on the image: xx, xy, yy, det."""
    rows = world_rows(camera, jacobian(camera, x, y, z))
    if full:
        return covariance_of_full(rows, symmetric(scratch))
    qw, qx, qy, qz, _ = unit_quaternion(scratch)
    sx, sy, sz = column(scratch, SHAPE + 4), column(scratch, SHAPE + 5), column(scratch, SHAPE + 6)
    return covariance_of_half(half_covariance(rows, rotation(qw, qx, qy, qz), sx, sy, sz))


@kernel
def project_chunk(camera: Any, full: bool, antialiased: bool, scratch: Any, out: Any) -> None:
    """Project the gathered rows into columns of out: reach (2; -1 if unseen), mean (2), depth, factors, rho.

    The reach is the half extent in pixels of the region where alpha can pass the cutoff.
    """
    x, y, z = to_camera(camera, column(scratch, MEAN), column(scratch, MEAN + 1), column(scratch, MEAN + 2))
    xx, xy, yy, sharp = shape_on_image(camera, full, scratch, x, y, z)
    blur, total = camera[cam.EPS2D], column(scratch, TOTAL)
    det = sharp + blur * (xx + yy) + blur * blur
    xx, yy = xx + blur, yy + blur
    mx, my = mean_to_image(camera, x, y, z)
    rho = sqrt(sharp / det) if antialiased else splat(1.0)
    opacity = column(scratch, OPACITY) * rho
    exponent = maximum(log2(opacity) - camera[cam.LOG2_CUTOFF], 0.0)
    inverse, inverse_yy, sigmas = 1.0 / det, 1.0 / yy, sqrt(exponent * (1.0 / KAPPA))
    rx, ry = sigmas * sqrt(xx), sigmas * sqrt(yy)
    visible = (total < math.inf) & (z > camera[cam.NEAR]) & (z < camera[cam.FAR]) & (det > 0.0) & (det < math.inf)
    visible = visible & (opacity > 0.0) & (maximum(rx, ry) > math.floor(camera[cam.RADIUS_CLIP]))
    visible = visible & (mx + rx > 0.0) & (mx - rx < camera[cam.WIDTH])
    visible = visible & (my + ry > 0.0) & (my - ry < camera[cam.HEIGHT])
    a = maximum(sqrt(KAPPA * yy * inverse), TINY)
    store(out, 0, select(visible, rx, splat(-1.0)))
    store(out, LANES, ry)
    store(out, 2 * LANES, mx)
    store(out, 3 * LANES, my)
    store(out, 4 * LANES, z)
    store(out, 5 * LANES, a)
    store(out, 6 * LANES, -a * xy * inverse_yy)
    store(out, 7 * LANES, maximum(sqrt(KAPPA * inverse_yy), TINY))
    store(out, 8 * LANES, rho)


@kernel
def write_rows(
    i: int, count: int, out: Any, radii: Any, means2d: Any, residuals: Any, depths: Any, factors: Any,
    compensations: Any, order_keys: Any,
) -> None:  # fmt: skip
    """Copy columns of out to rows i, ..., i + count - 1; zeros where not visible."""
    for lane in range(count):
        row, visible = i + lane, out[lane] >= 0.0
        for k in range(2):
            value = out[(2 + k) * LANES + lane] if visible else 0.0
            radii[row, k] = int(min(math.ceil(out[k * LANES + lane]), 2.0**30)) if visible else 0
            means2d[row, k] = value
            residuals[row, k] = value - float(means2d[row, k])
        order_keys[row] = out[4 * LANES + lane] if visible else 0.0
        depths[row] = order_keys[row]
        for k in range(3):
            factors[row, k] = out[(5 + k) * LANES + lane] if visible else 0.0
        if compensations.shape[0] > 0:
            compensations[row] = out[8 * LANES + lane] if visible else 0.0


@kernel
def project_forward(
    start: int, stop: int, camera: Any, antialiased: bool, means: Any, quats: Any, scales: Any, covars: Any,
    opacities: Any, features: Any, radii: Any, means2d: Any, residuals: Any, depths: Any, factors: Any,
    compensations: Any, order_keys: Any, invalid: Any,
) -> int:  # fmt: skip
    """Fill rows [start, stop); rows that are not visible get zeros. Returns a row with a negative scale, or -1.

    residuals hold what rounding took from means2d; order_keys the depth in float64, by which Gaussians are sorted.
    """
    scratch, out, negative = np.zeros(INPUTS * LANES), np.empty(9 * LANES), -1
    full = covars.shape[0] > 0
    for i in range(start, stop, LANES):
        count = min(LANES, stop - i)
        gather_inputs(i, count, means, quats, scales, covars, opacities, scratch)
        negative = max(negative, check_rows(i, count, features, scales, not full, scratch, invalid))
        project_chunk(camera, full, antialiased, scratch, out)
        write_rows(i, count, out, radii, means2d, residuals, depths, factors, compensations, order_keys)
    return negative
