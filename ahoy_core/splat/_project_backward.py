"""Reverse of `_project`: gradients of image-plane quantities back to Gaussians and camera pose, in float64."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from ahoy_core.splat import _camera as cam
from ahoy_core.splat._jit import inlined, kernel
from ahoy_core.splat._powers import sqrt
from ahoy_core.splat._project import (
    INPUTS,
    MEAN,
    SHAPE,
    Vecs,
    column,
    covariance_of_full,
    covariance_of_half,
    gather_inputs,
    half_covariance,
    jacobian,
    rotation,
    symmetric,
    to_camera,
    unit_quaternion,
    world_rows,
)
from ahoy_core.splat._reductions import lane_sum
from ahoy_core.splat._simd import load, maximum, minimum, select, splat, store
from ahoy_core.splat._vectors import LANES
from ahoy_core.splat.constants import KAPPA

V_MEAN2D, V_DEPTH, V_FACTOR, V_RHO, SEEN = 0, 2, 3, 6, 7  # columns of the incoming gradients
GRADIENTS: Final = 8
RESULTS: Final = 10  # mean (3), then quaternion (4) and scales (3), or the symmetric covariance (6)


@inlined
def from_factors(xx: Any, xy: Any, yy: Any, det: Any, v: Any) -> Vecs:
    """Gradient of the blurred covariance from that of a = sqrt(KAPPA yy / det), b = -a xy / yy, c = sqrt(KAPPA / yy).

    d det = yy dxx + xx dyy - 2 xy dxy is folded in, which leaves no difference of large numbers for needles.
    """
    va, vb, vc = column(v, V_FACTOR), column(v, V_FACTOR + 1), column(v, V_FACTOR + 2)
    inverse, slope = 1.0 / det, xy / yy
    a, inverse_yy = sqrt(KAPPA * yy * inverse), 1.0 / yy
    inner = (va - vb * slope) * a
    v_xx = -0.5 * inner * yy * inverse
    v_xy = inner * xy * inverse - vb * a * inverse_yy
    v_yy = -0.5 * inner * xy * slope * inverse + vb * a * slope * inverse_yy
    return v_xx, v_xy, v_yy - 0.5 * vc * sqrt(KAPPA * inverse_yy) * inverse_yy


@inlined
def from_compensation(blur: float, xx: Any, xy: Any, yy: Any, sharp: Any, det: Any, v: Any) -> Vecs:
    """Gradient of the covariance from that of sqrt(sharp / det); xx and yy include the blur.

    A visible Gaussian has sharp > 0: with a zero determinant its compensated opacity is 0 and it was culled.
    """
    inverse, of_sharp = 1.0 / det, 1.0 / sharp
    half = 0.5 * column(v, V_RHO) * sqrt(sharp * inverse)
    return (
        half * ((yy - blur) * of_sharp - yy * inverse),
        -2.0 * half * xy * (of_sharp - inverse),
        half * ((xx - blur) * of_sharp - xx * inverse),
    )


@inlined
def covariance_gradient(camera: Any, xx: Any, xy: Any, yy: Any, sharp: Any, v: Any, antialiased: bool) -> Vecs:
    """Sum of all that reaches the blurred covariance (xx, xy, yy)."""
    blur = camera[cam.EPS2D]
    det = sharp + blur * (xx + yy) + blur * blur
    xx, yy = xx + blur, yy + blur
    g0, g1, g2 = from_factors(xx, xy, yy, det, v)
    if antialiased:
        h0, h1, h2 = from_compensation(blur, xx, xy, yy, sharp, det, v)
        g0, g1, g2 = g0 + h0, g1 + h1, g2 + h2
    return g0, g1, g2


@inlined
def to_mean(camera: Any, x: Any, y: Any, z: Any, v_j: Vecs, v_mx: Any, v_my: Any) -> Vecs:
    """Gradient of the camera-space mean from those of the Jacobian (j0, j2, k1, k2) and of the image mean."""
    fx, fy = camera[cam.FX], camera[cam.FY]
    if camera[cam.ORTHO] != 0.0:
        return fx * v_mx, fy * v_my, splat(0.0)
    rz = 1.0 / z
    p, q, square = x * rz, y * rz, rz * rz
    u = minimum(maximum(p, camera[cam.X_MIN]), camera[cam.X_MAX])
    v = minimum(maximum(q, camera[cam.Y_MIN]), camera[cam.Y_MAX])
    inner_x, inner_y = fx * square * v_j[1], fy * square * v_j[3]
    free_x = select((p >= camera[cam.X_MIN]) & (p <= camera[cam.X_MAX]), inner_x, splat(0.0))
    free_y = select((q >= camera[cam.Y_MIN]) & (q <= camera[cam.Y_MAX]), inner_y, splat(0.0))
    vz = -(fx * x * v_mx + fy * y * v_my + fx * v_j[0] + fy * v_j[2]) * square
    vz = vz + u * (inner_x + free_x) + v * (inner_y + free_y)
    return fx * rz * v_mx - free_x, fy * rz * v_my - free_y, vz


@inlined
def to_quaternion(q: Vecs, G: Vecs) -> Vecs:
    """Gradient of a quaternion of any length from that of its rotation; a zero quaternion gets none."""
    w, x, y, z, inverse = q
    vw = 2.0 * (x * (G[7] - G[5]) + y * (G[2] - G[6]) + z * (G[3] - G[1]))
    vx = 2.0 * (-2.0 * x * (G[4] + G[8]) + y * (G[1] + G[3]) + z * (G[2] + G[6]) + w * (G[7] - G[5]))
    vy = 2.0 * (x * (G[1] + G[3]) - 2.0 * y * (G[0] + G[8]) + z * (G[5] + G[7]) + w * (G[2] - G[6]))
    vz = 2.0 * (x * (G[2] + G[6]) + y * (G[5] + G[7]) - 2.0 * z * (G[0] + G[4]) + w * (G[3] - G[1]))
    along = vw * w + vx * x + vy * y + vz * z
    vw, vx, vy, vz = vw - w * along, vx - x * along, vy - y * along, vz - z * along
    return vw * inverse, vx * inverse, vy * inverse, vz * inverse


@inlined
def to_quats_and_scales(rows: Vecs, B: Vecs, g: Vecs, q: Vecs, R: Vecs, scratch: Any, out: Any) -> Vecs:
    """Write the gradients of quaternion and scales; returns that of the rows J R_cam."""
    sx, sy, sz = column(scratch, SHAPE + 4), column(scratch, SHAPE + 5), column(scratch, SHAPE + 6)
    a, b, c, d, e, f = rows
    twice0, twice2 = 2.0 * g[0], 2.0 * g[2]
    u0, u1, u2 = twice0 * B[0] + g[1] * B[3], twice0 * B[1] + g[1] * B[4], twice0 * B[2] + g[1] * B[5]
    v0, v1, v2 = twice2 * B[3] + g[1] * B[0], twice2 * B[4] + g[1] * B[1], twice2 * B[5] + g[1] * B[2]
    m0, m1, m2 = a * u0 + d * v0, a * u1 + d * v1, a * u2 + d * v2
    m3, m4, m5 = b * u0 + e * v0, b * u1 + e * v1, b * u2 + e * v2
    m6, m7, m8 = c * u0 + f * v0, c * u1 + f * v1, c * u2 + f * v2
    store(out, 7 * LANES, m0 * R[0] + m3 * R[3] + m6 * R[6])
    store(out, 8 * LANES, m1 * R[1] + m4 * R[4] + m7 * R[7])
    store(out, 9 * LANES, m2 * R[2] + m5 * R[5] + m8 * R[8])
    G = (m0 * sx, m1 * sy, m2 * sz, m3 * sx, m4 * sy, m5 * sz, m6 * sx, m7 * sy, m8 * sz)
    vw, vx, vy, vz = to_quaternion(q, G)
    store(out, 3 * LANES, vw)
    store(out, 4 * LANES, vx)
    store(out, 5 * LANES, vy)
    store(out, 6 * LANES, vz)
    u0, u1, u2, v0, v1, v2 = u0 * sx, u1 * sy, u2 * sz, v0 * sx, v1 * sy, v2 * sz
    return (
        u0 * R[0] + u1 * R[1] + u2 * R[2], u0 * R[3] + u1 * R[4] + u2 * R[5], u0 * R[6] + u1 * R[7] + u2 * R[8],
        v0 * R[0] + v1 * R[1] + v2 * R[2], v0 * R[3] + v1 * R[4] + v2 * R[5], v0 * R[6] + v1 * R[7] + v2 * R[8],
    )  # fmt: skip


@inlined
def to_covars(rows: Vecs, S: Vecs, g: Vecs, out: Any) -> Vecs:
    """Write T^T G T, the gradient of the covariance; returns that of the rows T = J R_cam, 2 G T S."""
    a, b, c, d, e, f = rows
    half = 0.5 * g[1]
    p, q, r = g[0] * a + half * d, g[0] * b + half * e, g[0] * c + half * f
    s, t, w = half * a + g[2] * d, half * b + g[2] * e, half * c + g[2] * f
    store(out, 3 * LANES, a * p + d * s)
    store(out, 4 * LANES, a * q + d * t)
    store(out, 5 * LANES, a * r + d * w)
    store(out, 6 * LANES, b * q + e * t)
    store(out, 7 * LANES, b * r + e * w)
    store(out, 8 * LANES, c * r + f * w)
    return (
        2.0 * (p * S[0] + q * S[1] + r * S[2]), 2.0 * (p * S[1] + q * S[3] + r * S[4]),
        2.0 * (p * S[2] + q * S[4] + r * S[5]), 2.0 * (s * S[0] + t * S[1] + w * S[2]),
        2.0 * (s * S[1] + t * S[3] + w * S[4]), 2.0 * (s * S[2] + t * S[4] + w * S[5]),
    )  # fmt: skip


@inlined
def add_pose(pose: Any, k: int, seen: Any, value: Any) -> None:
    """Add the lanes that were seen to the k-th of the pose's sums."""
    store(pose, k * LANES, load(pose, k * LANES) + select(seen, value, splat(0.0)))


@inlined
def shape_backward(camera: Any, full: bool, rows: Vecs, scratch: Any, v: Any, antialiased: bool, out: Any) -> Vecs:
    """Write the gradients of the shape's inputs; returns that of the rows J R_cam."""
    if full:
        S = symmetric(scratch)
        xx, xy, yy, sharp = covariance_of_full(rows, S)
        return to_covars(rows, S, covariance_gradient(camera, xx, xy, yy, sharp, v, antialiased), out)
    q = unit_quaternion(scratch)
    R = rotation(q[0], q[1], q[2], q[3])
    sx, sy, sz = column(scratch, SHAPE + 4), column(scratch, SHAPE + 5), column(scratch, SHAPE + 6)
    B = half_covariance(rows, R, sx, sy, sz)
    xx, xy, yy, sharp = covariance_of_half(B)
    g = covariance_gradient(camera, xx, xy, yy, sharp, v, antialiased)
    return to_quats_and_scales(rows, B, g, q, R, scratch, out)


@kernel
def project_chunk_backward(
    camera: Any, full: bool, scratch: Any, v: Any, antialiased: bool, out: Any, pose: Any
) -> None:
    """Gradients of sixteen gathered rows into columns of out; those of [R | t] are added to pose [12 x 16]."""
    wx, wy, wz = column(scratch, MEAN), column(scratch, MEAN + 1), column(scratch, MEAN + 2)
    seen = column(v, SEEN) > 0.0
    x, y, z = to_camera(camera, wx, wy, wz)
    j = jacobian(camera, x, y, z)
    r = shape_backward(camera, full, world_rows(camera, j), scratch, v, antialiased, out)
    v_j = (
        r[0] * camera[0] + r[1] * camera[1] + r[2] * camera[2], r[0] * camera[6] + r[1] * camera[7] + r[2] * camera[8],
        r[3] * camera[3] + r[4] * camera[4] + r[5] * camera[5], r[3] * camera[6] + r[4] * camera[7] + r[5] * camera[8],
    )  # fmt: skip
    vx, vy, vz = to_mean(camera, x, y, z, v_j, column(v, V_MEAN2D), column(v, V_MEAN2D + 1))
    vz = vz + column(v, V_DEPTH)
    store(out, 0, camera[0] * vx + camera[3] * vy + camera[6] * vz)
    store(out, LANES, camera[1] * vx + camera[4] * vy + camera[7] * vz)
    store(out, 2 * LANES, camera[2] * vx + camera[5] * vy + camera[8] * vz)
    for k, world in enumerate((wx, wy, wz)):
        add_pose(pose, k, seen, j[0] * r[k] + vx * world)
        add_pose(pose, 3 + k, seen, j[2] * r[3 + k] + vy * world)
        add_pose(pose, 6 + k, seen, j[1] * r[k] + j[3] * r[3 + k] + vz * world)
    add_pose(pose, 9, seen, vx)
    add_pose(pose, 10, seen, vy)
    add_pose(pose, 11, seen, vz)


@kernel
def gather_gradients_in(
    i: int, count: int, radii: Any, v_means2d: Any, v_depths: Any, v_factors: Any, v_comps: Any, v: Any
) -> bool:
    """Columns of the incoming gradients of rows i, ...; arrays without rows count as zero. Whether any row was seen."""
    seen = False
    for lane in range(count):
        row = i + lane
        v[SEEN * LANES + lane] = 1.0 if radii[row, 0] > 0 else 0.0
        seen = seen or radii[row, 0] > 0
        if v_means2d.shape[0] > 0:
            v[lane], v[LANES + lane] = v_means2d[row, 0], v_means2d[row, 1]
        if v_depths.shape[0] > 0:
            v[V_DEPTH * LANES + lane] = v_depths[row]
        for k in range(3):
            if v_factors.shape[0] > 0:
                v[(V_FACTOR + k) * LANES + lane] = v_factors[row, k]
        if v_comps.shape[0] > 0:
            v[V_RHO * LANES + lane] = v_comps[row]
    for lane in range(count, LANES):
        v[SEEN * LANES + lane] = 0.0
    return seen


@kernel
def add_rows(
    i: int, count: int, full: bool, v: Any, out: Any, v_means: Any, v_quats: Any, v_scales: Any, v_covars: Any
) -> None:
    """Add columns of out to the rows that were seen."""
    for lane in range(count):
        row = i + lane
        if v[SEEN * LANES + lane] == 0.0:
            continue
        for k in range(3):
            v_means[row, k] += out[k * LANES + lane]
        if full:
            at = 3
            for k in range(3):
                for m in range(k, 3):
                    v_covars[row, k, m] += out[at * LANES + lane]
                    if m > k:
                        v_covars[row, m, k] += out[at * LANES + lane]
                    at += 1
        else:
            for k in range(4):
                v_quats[row, k] += out[(3 + k) * LANES + lane]
            for k in range(3):
                v_scales[row, k] += out[(7 + k) * LANES + lane]


@kernel
def project_backward(
    start: int, stop: int, camera: Any, means: Any, quats: Any, scales: Any, covars: Any, opacities: Any, radii: Any,
    v_means2d: Any, v_depths: Any, v_factors: Any, v_comps: Any,
    v_means: Any, v_quats: Any, v_scales: Any, v_covars: Any, pose: Any,
) -> None:  # fmt: skip
    """Add one camera's gradients of rows [start, stop) to the v_ arrays and to pose [12]; unseen rows are skipped."""
    scratch, v, out = np.zeros(INPUTS * LANES), np.zeros(GRADIENTS * LANES), np.empty(RESULTS * LANES)
    sums, full = np.zeros(12 * LANES), covars.shape[0] > 0
    antialiased = v_comps.shape[0] > 0
    for i in range(start, stop, LANES):
        count = min(LANES, stop - i)
        if not gather_gradients_in(i, count, radii, v_means2d, v_depths, v_factors, v_comps, v):
            continue
        gather_inputs(i, count, means, quats, scales, covars, opacities, scratch)
        project_chunk_backward(camera, full, scratch, v, antialiased, out, sums)
        add_rows(i, count, full, v, out, v_means, v_quats, v_scales, v_covars)
    for k in range(12):
        pose[k] += lane_sum(load(sums, k * LANES))
