"""Reverse of `_blend`: back to front, with a scalar suffix sum per pixel and 6 + D moments per Gaussian.

With power = log2 o - u^2 - w^2, u = a dx + b dy, w = c dy and h = alpha dL/dalpha, everything that a Gaussian's shape,
place and opacity need are sums over pixels of h, hu, hw, hu^2, huw and hw^2.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from ahoy_core.splat._binning import HEAD
from ahoy_core.splat._blend import AHEAD, whiten
from ahoy_core.splat._channels import channel_dot, channel_weigh, splat_channels, zero_channels
from ahoy_core.splat._jit import kernel
from ahoy_core.splat._simd import (
    LANES,
    add_sums,
    bits,
    exp2,
    fma,
    fnma,
    lane_sum,
    load,
    lowest_bit,
    minimum,
    prefetch,
    select,
    splat,
    store,
)
from ahoy_core.splat.constants import LN2

MOMENTS: Final = 6


@kernel
def load_tile(
    tile: int, x: int, y: int, grid: Any, background: Any, v_image: Any, v_alphas: Any, rests: Any, lasts: Any,
    state: Any, stride: int, last: Any, deepest: Any, v_background: Any,
) -> int:  # fmt: skip
    """Fill a tile's state: transmittance, suffix sum, gradient of each channel. Returns the last rank of all.

    The suffix sum starts with the gradient through the background, T (background . v_color - v_alpha).
    """
    height, width, channels = v_image.shape
    blocks = (grid.shape[0] - 32) // 2
    furthest = -1
    for block in range(rests.shape[1] // LANES):
        left, top, base = x + int(grid[32 + block]), y + int(grid[32 + blocks + block]), block * stride
        deepest[block] = -1
        for lane in range(LANES):
            column, row, at = left + lane % 4, top + lane // 4, block * LANES + lane
            inside = column < width and row < height
            rest = rests[tile, at]
            state[base + lane] = rest if inside else state.dtype.type(1.0)
            last[at] = lasts[tile, at]
            deepest[block] = max(deepest[block], last[at])
            behind = -v_alphas[row, column, 0] if inside else state.dtype.type(0.0)
            for k in range(channels):
                value = v_image[row, column, k] if inside else state.dtype.type(0.0)
                state[base + (2 + k) * LANES + lane] = value
                behind += background[k] * value
            state[base + LANES + lane] = rest * behind if inside else state.dtype.type(0.0)
        furthest = max(furthest, deepest[block])
        for k in range(len(v_background)):
            v_background[k] += lane_sum(load(state, base) * load(state, base + (2 + k) * LANES))
    return furthest


@kernel
def unblend_tile(
    start: int, furthest: int, ids: Any, masks: Any, records: Any, grid: Any, x: int, y: int, like: Any, limits: Any,
    state: Any, last: Any, deepest: Any, offsets: Any, sums: Any,
) -> None:  # fmt: skip
    """Walk a tile's intersections from the furthest to the first and add each one's moments to sums [slots, 6 + D]."""
    stride = (2 + len(like)) * LANES
    lane_x, lane_y = load(grid, 0), load(grid, LANES)
    power_cut, alpha_max, one = splat(limits[0]), splat(limits[1]), splat(limits[3])
    zero = lane_x - lane_x
    for k in range(start + furthest, start - 1, -1):
        if k - AHEAD >= start:
            prefetch(records, ids[k - AHEAD] * records.shape[1])
            prefetch(sums, ids[k - AHEAD] * sums.shape[1])
        rank = splat(np.int32(k - start))
        todo = np.uint64(0)
        for group in range(deepest.shape[0] // LANES):
            todo |= bits(load(deepest, group * LANES) >= rank) << np.uint64(group * LANES)
        todo &= np.uint64(masks[k])
        if todo == np.uint64(0):
            continue
        slot = ids[k]
        u_lane = fma(lane_x, splat(records[slot, 4]), lane_y * records[slot, 5])
        w_lane = lane_y * records[slot, 6]
        power_max = splat(records[slot, 7])
        colors = splat_channels(records, slot * records.shape[1] + HEAD, like)
        shades = zero_channels(zero, like)
        h0, hu, hw, huu, huw, hww = zero, zero, zero, zero, zero, zero
        group, any_hit = -1, False
        while todo != np.uint64(0):
            block = lowest_bit(todo)
            todo &= todo - np.uint64(1)
            if block // LANES != group:
                group = block // LANES
                whiten(records, slot, grid, group, x, y, offsets)
            u, w = u_lane + offsets[block % LANES], w_lane + offsets[LANES + block % LANES]
            power = fnma(w, w, fnma(u, u, power_max))
            hit = (power >= power_cut) & (load(last, block * LANES) >= rank)
            if bits(hit) == np.uint64(0):
                continue
            any_hit, base = True, block * stride
            raw = exp2(power)
            alpha = select(hit, minimum(raw, alpha_max), zero)
            inverse = one / (one - alpha)
            before = load(state, base) * inverse
            store(state, base, before)
            weight, suffix = alpha * before, load(state, base + LANES)
            shade = channel_dot(colors, state, base + 2 * LANES)
            store(state, base + LANES, fma(weight, shade, suffix))
            shades = channel_weigh(shades, weight, state, base + 2 * LANES)
            h = select(raw <= alpha_max, fnma(suffix, inverse, before * shade) * alpha, zero)
            h_u, h_w = h * u, h * w
            h0, hu, hw = h0 + h, hu + h_u, hw + h_w
            huu, huw, hww = fma(h_u, u, huu), fma(h_u, w, huw), fma(h_w, w, hww)
        if any_hit:
            add_sums(sums, slot * sums.shape[1], (h0, hu, hw, huu, huw, hww) + shades)


@kernel
def blend_backward(
    part: int, parts: int, starts: Any, ids: Any, masks: Any, records: Any, grid: Any, tile_size: int, like: Any,
    limits: Any, background: Any, v_image: Any, v_alphas: Any, rests: Any, lasts: Any, state: Any, offsets: Any,
    sums: Any, v_background: Any,
) -> None:  # fmt: skip
    """Add the moments of every parts-th tile to sums and the background's gradient to v_background [D] (float64)."""
    width = v_image.shape[1]
    tiles_x = (width + tile_size - 1) // tile_size
    stride, blocks = (2 + len(like)) * LANES, (grid.shape[0] - 32) // 2
    last, deepest = np.empty(blocks * LANES, np.int32), np.full(blocks, np.int32(-1))
    for k in range(len(state)):
        state[k] = 0
    for tile in range(part, len(starts) - 1, parts):
        x, y = tile % tiles_x * tile_size, tile // tiles_x * tile_size
        furthest = load_tile(
            tile, x, y, grid, background, v_image, v_alphas, rests, lasts, state, stride, last, deepest, v_background
        )
        unblend_tile(
            starts[tile], furthest, ids, masks, records, grid, x, y, like, limits, state, last, deepest, offsets, sums
        )


@kernel
def gather_gradients(
    start: int, stop: int, slots: Any, records: Any, opacities: Any, sums: Any, v_means2d: Any, v_factors: Any,
    v_opacities: Any, v_features: Any,
) -> None:  # fmt: skip
    """Moments of all threads [P, slots, 6 + D] -> gradients of rows [start, stop), summed in the order of threads."""
    parts, channels = sums.shape[0], v_features.shape[1]
    for i in range(start, stop):
        slot = slots[i]
        if slot < 0:
            continue
        m0, m1, m2, m3, m4, m5 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for p in range(parts):
            m0, m1, m2 = m0 + sums[p, slot, 0], m1 + sums[p, slot, 1], m2 + sums[p, slot, 2]
            m3, m4, m5 = m3 + sums[p, slot, 3], m4 + sums[p, slot, 4], m5 + sums[p, slot, 5]
        for k in range(channels):
            total = 0.0
            for p in range(parts):
                total += sums[p, slot, MOMENTS + k]
            v_features[i, k] += total
        a, b, c = float(records[slot, 4]), float(records[slot, 5]), float(records[slot, 6])
        v_means2d[i, 0], v_means2d[i, 1] = 2.0 * LN2 * a * m1, 2.0 * LN2 * (b * m1 + c * m2)
        v_factors[i, 0] = -2.0 * LN2 * (m3 - b / c * m4) / a
        v_factors[i, 1], v_factors[i, 2] = -2.0 * LN2 * m4 / c, -2.0 * LN2 * m5 / c
        v_opacities[i] = m0 / opacities[i]
