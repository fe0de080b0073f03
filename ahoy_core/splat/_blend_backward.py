"""Reverse of `_blend`: back to front, with a scalar suffix sum per pixel and 6 + D moments per Gaussian.

With power = log2 o - u^2 - w^2, u = a dx + b dy, w = c dy and h = alpha dL/dalpha, everything that a Gaussian's shape,
place and opacity need are sums over pixels of h, hu, hw, hu^2, huw and hw^2.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from ahoy_core.splat._binning import HEAD
from ahoy_core.splat._blend import AHEAD, block_corner, whiten
from ahoy_core.splat._channels import channel_dot, channel_weigh, splat_channels, zero_channels
from ahoy_core.splat._jit import kernel
from ahoy_core.splat._powers import exp2
from ahoy_core.splat._reductions import add_sums, lane_max, lane_sum
from ahoy_core.splat._simd import bits, fma, fnma, load, lowest_bit, minimum, prefetch, select, splat, store
from ahoy_core.splat._vectors import LANES
from ahoy_core.splat.constants import LN2

MOMENTS: Final = 6


@kernel
def load_tile(x: int, y: int, side: int, like: Any, v_image: Any, v_alphas: Any, state: Any) -> None:
    """Gather the gradients of a tile's channels, and of alpha in place of the suffix sum; 0 outside the image."""
    height, width, channels = v_image.shape
    stride, zero = (2 + len(like)) * LANES, splat(state.dtype.type(0.0))
    for block in range(side * side):
        left, top = block_corner(block, x, y, side)
        base, columns, rows = block * stride + LANES, min(4, width - left), min(4, height - top)
        if columns < 4 or rows < 4:
            for k in range(1 + len(like)):
                store(state, base + k * LANES, zero)
        for row in range(rows):
            for column in range(columns):
                lane = 4 * row + column
                state[base + lane] = v_alphas[top + row, left + column, 0] if v_alphas.shape[0] > 0 else 0.0
                for k in range(len(like)):
                    if k < channels:
                        state[base + (k + 1) * LANES + lane] = v_image[top + row, left + column, k]


@kernel
def start_suffix(
    tile: int, side: int, background: Any, like: Any, rests: Any, lasts: Any, state: Any, last: Any, deepest: Any,
    v_background: Any,
) -> int:  # fmt: skip
    """Load transmittances and ranks and start the suffix sums with what the background carries.

    That is T (background . v_color - v_alpha). Returns the last rank of the tile.
    """
    stride, furthest = (2 + len(like)) * LANES, -1
    behind = splat_channels(background, 0, like)
    for block in range(side * side):
        base, rest = block * stride, load(rests, tile * rests.shape[1] + block * LANES)
        store(state, base, rest)
        for lane in range(LANES):
            last[block * LANES + lane] = lasts[tile, block * LANES + lane]
        ranks = load(last, block * LANES)
        carried = channel_dot(behind, state, base + 2 * LANES) - load(state, base + LANES)
        store(state, base + LANES, rest * carried)
        deepest[block] = lane_max(ranks)
        furthest = max(furthest, deepest[block])
        for k in range(len(v_background)):
            v_background[k] += lane_sum(rest * load(state, base + (2 + k) * LANES))
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
            add_sums(sums, slot * sums.shape[1], (h0, hu, hw, huu, huw, hww) + shades)  # noqa: RUF005


@kernel
def blend_backward(
    part: int, parts: int, starts: Any, ids: Any, masks: Any, records: Any, grid: Any, tile_size: int, like: Any,
    limits: Any, background: Any, v_image: Any, v_alphas: Any, rests: Any, lasts: Any, state: Any, offsets: Any,
    sums: Any, v_background: Any,
) -> None:  # fmt: skip
    """Add the moments of every parts-th tile to sums and the background's gradient to v_background [D] (float64)."""
    tiles_x, side = (v_image.shape[1] + tile_size - 1) // tile_size, tile_size // 4
    last, deepest = np.empty(side * side * LANES, np.int32), np.full(max(LANES, side * side), np.int32(-1))
    for tile in range(part, len(starts) - 1, parts):
        x, y = tile % tiles_x * tile_size, tile // tiles_x * tile_size
        load_tile(x, y, side, like, v_image, v_alphas, state)
        furthest = start_suffix(tile, side, background, like, rests, lasts, state, last, deepest, v_background)
        unblend_tile(
            starts[tile], furthest, ids, masks, records, grid, x, y, like, limits, state, last, deepest, offsets, sums
        )


@kernel
def moments_to_gradients(scratch: Any) -> None:
    """Columns of scratch: moments (6), factors (3), opacity become gradients of mean (2), factors and opacity."""
    hu, hw = load(scratch, LANES), load(scratch, 2 * LANES)
    huu, huw, hww = load(scratch, 3 * LANES), load(scratch, 4 * LANES), load(scratch, 5 * LANES)
    a, b, c = load(scratch, 6 * LANES), load(scratch, 7 * LANES), load(scratch, 8 * LANES)
    v_opacity = load(scratch, 0) / load(scratch, 9 * LANES)
    inverse = -2.0 * LN2 / c
    store(scratch, 0, 2.0 * LN2 * a * hu)
    store(scratch, LANES, 2.0 * LN2 * (b * hu + c * hw))
    store(scratch, 2 * LANES, (-2.0 * LN2 * huu - b * inverse * huw) / a)
    store(scratch, 3 * LANES, inverse * huw)
    store(scratch, 4 * LANES, inverse * hww)
    store(scratch, 5 * LANES, v_opacity)


@kernel
def gather_gradients(
    start: int, stop: int, slots: Any, factors: Any, opacities: Any, sums: Any, v_means2d: Any, v_factors: Any,
    v_opacities: Any, v_features: Any,
) -> None:  # fmt: skip
    """Moments [slots, 6 + D] -> gradients of rows [start, stop); 0 where not visible."""
    scratch = np.ones(10 * LANES)
    for i in range(start, stop, LANES):
        count = min(LANES, stop - i)
        for row in range(min(i + LANES, stop), min(i + 2 * LANES, stop)):
            if slots[row] >= 0:
                prefetch(sums, slots[row] * sums.shape[1])
                prefetch(sums, (slots[row] + 1) * sums.shape[1] - 1)
        for lane in range(count):
            if slots[i + lane] >= 0:
                for k in range(MOMENTS):
                    scratch[k * LANES + lane] = sums[slots[i + lane], k]
                for k in range(v_features.shape[1]):
                    v_features[i + lane, k] += sums[slots[i + lane], MOMENTS + k]
                for k in range(3):
                    scratch[(6 + k) * LANES + lane] = factors[i + lane, k]
                scratch[9 * LANES + lane] = opacities[i + lane]
        moments_to_gradients(scratch)
        for lane in range(count):
            seen = slots[i + lane] >= 0
            for k in range(2):
                v_means2d[i + lane, k] = scratch[k * LANES + lane] if seen else 0.0
            for k in range(3):
                v_factors[i + lane, k] = scratch[(2 + k) * LANES + lane] if seen else 0.0
            v_opacities[i + lane] = scratch[5 * LANES + lane] if seen else 0.0
