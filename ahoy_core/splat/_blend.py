"""Front-to-back blending of a tile's Gaussians, one 4 x 4 block of pixels per vector (Kerbl et al. 2023, eq. 2-3).

The state of a block is stored together (transmittance, alpha, then the channels), so a tile of 16 x 16 pixels and three
channels lives in 5 KB. Alpha is summed on its own, because 1 - transmittance has no digits left where it is faint. A pixel is finished when its transmittance would fall to the stop; that is kept as its sign.
All arithmetic is relative to the block's corner, so the image does not depend on tile size or number of threads.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ahoy_core.splat._binning import HEAD
from ahoy_core.splat._channels import channel_blend, splat_channels
from ahoy_core.splat._jit import kernel
from ahoy_core.splat._simd import (
    LANES,
    bits,
    exp2,
    fma,
    fnma,
    load,
    lowest_bit,
    minimum,
    prefetch,
    select,
    splat,
    store,
)

AHEAD = 6


@kernel
def whiten(records: Any, slot: int, grid: Any, group: int, x: int, y: int, offsets: Any) -> None:
    """Write (u, w) at the corners of sixteen blocks into offsets: u = a dx + b dy, w = c dy."""
    blocks = (grid.shape[0] - 32) // 2
    dx = (load(grid, 32 + 16 * group) + x - records[slot, 0]) - records[slot, 2]
    dy = (load(grid, 32 + blocks + 16 * group) + y - records[slot, 1]) - records[slot, 3]
    store(offsets, 0, fma(dx, splat(records[slot, 4]), dy * records[slot, 5]))
    store(offsets, LANES, dy * records[slot, 6])


@kernel
def start_tile(x: int, y: int, width: int, height: int, grid: Any, state: Any, stride: int, last: Any) -> Any:
    """Reset a tile's state: transmittance 1 inside the image, 0 outside. Returns the bits of blocks inside."""
    blocks = (grid.shape[0] - 32) // 2
    alive = np.uint64(0)
    one, zero = state.dtype.type(1.0), state.dtype.type(0.0)
    for block in range(blocks):
        left, top = x + int(grid[32 + block]), y + int(grid[32 + blocks + block])
        if left < width and top < height:
            alive |= np.uint64(1) << np.uint64(block)
        for k in range(stride):
            state[block * stride + k] = zero
        for lane in range(LANES):
            inside = left + lane % 4 < width and top + lane // 4 < height
            state[block * stride + lane] = one if inside else zero
            last[block * LANES + lane] = -1
    return alive


@kernel
def write_tile(
    x: int, y: int, width: int, height: int, grid: Any, state: Any, stride: int, background: Any, image: Any,
    alphas: Any,
) -> None:  # fmt: skip
    """Copy a tile's blocks into the image [H,W,D], with the background behind them."""
    blocks, channels = (grid.shape[0] - 32) // 2, image.shape[2]
    for block in range(blocks):
        left, top, base = x + int(grid[32 + block]), y + int(grid[32 + blocks + block]), block * stride
        for lane in range(LANES):
            column, row = left + lane % 4, top + lane // 4
            if column >= width or row >= height:
                continue
            rest = abs(state[base + lane])
            alphas[row, column, 0] = state[base + LANES + lane]
            for k in range(channels):
                image[row, column, k] = state[base + (k + 2) * LANES + lane] + rest * background[k]


@kernel
def blend_tile(
    start: int, stop: int, ids: Any, masks: Any, records: Any, grid: Any, x: int, y: int, alive: Any, like: Any,
    limits: Any, state: Any, last: Any, offsets: Any,
) -> None:  # fmt: skip
    """Blend intersections [start, stop) into a tile's state until they or its living blocks end."""
    stride = (2 + len(like)) * LANES
    lane_x, lane_y = load(grid, 0), load(grid, LANES)
    power_cut, alpha_max, end = splat(limits[0]), splat(limits[1]), splat(limits[2])
    zero = lane_x - lane_x
    for k in range(start, stop):
        todo = np.uint64(masks[k]) & alive
        if k + AHEAD < stop:
            prefetch(records, ids[k + AHEAD] * records.shape[1])
        if todo == np.uint64(0):
            continue
        slot = ids[k]
        u_lane = fma(lane_x, splat(records[slot, 4]), lane_y * records[slot, 5])
        w_lane = lane_y * records[slot, 6]
        power_max = splat(records[slot, 7])
        colors = splat_channels(records, slot * records.shape[1] + HEAD, like)
        rank = splat(np.int32(k - start))
        group = -1
        while todo != np.uint64(0):
            block = lowest_bit(todo)
            todo &= todo - np.uint64(1)
            if block // LANES != group:
                group = block // LANES
                whiten(records, slot, grid, group, x, y, offsets)
            u, w = u_lane + offsets[block % LANES], w_lane + offsets[LANES + block % LANES]
            power = fnma(w, w, fnma(u, u, power_max))
            base = block * stride
            before = load(state, base)
            hit = (power >= power_cut) & (before > zero)
            if bits(hit) == np.uint64(0):
                continue
            alpha = select(hit, minimum(exp2(power), alpha_max), zero)
            after = fnma(alpha, before, before)
            going = after > end
            weight = select(going, alpha * before, zero)
            channel_blend(colors, weight, state, base + 2 * LANES)
            store(state, base + LANES, load(state, base + LANES) + weight)
            both = hit & going
            store(last, block * LANES, select(both, rank, load(last, block * LANES)))
            after = select(going, after, select(hit, zero - before, before))
            store(state, base, after)
            if bits(both) != bits(hit) and bits(after > zero) == np.uint64(0):
                alive &= ~(np.uint64(1) << np.uint64(block))
        if alive == np.uint64(0):
            break


@kernel
def blend_forward(
    part: int, parts: int, starts: Any, ids: Any, masks: Any, records: Any, grid: Any, tile_size: int, like: Any,
    limits: Any, background: Any, image: Any, alphas: Any, rests: Any, lasts: Any, state: Any, offsets: Any,
) -> None:  # fmt: skip
    """Render every parts-th tile of one camera.

    rests and lasts [tiles, pixels of a tile] keep the final transmittance and the rank of the last Gaussian blended,
    for the backward pass; without rows they are not kept. state, offsets: scratch of this thread.
    """
    height, width = image.shape[0], image.shape[1]
    tiles_x = (width + tile_size - 1) // tile_size
    stride, blocks = (2 + len(like)) * LANES, (grid.shape[0] - 32) // 2
    last = np.empty(blocks * LANES, np.int32)
    for tile in range(part, len(starts) - 1, parts):
        x, y = tile % tiles_x * tile_size, tile // tiles_x * tile_size
        alive = start_tile(x, y, width, height, grid, state, stride, last)
        blend_tile(
            starts[tile], starts[tile + 1], ids, masks, records, grid, x, y, alive, like, limits, state, last, offsets
        )
        write_tile(x, y, width, height, grid, state, stride, background, image, alphas)
        if rests.shape[0] > 0:
            for block in range(rests.shape[1] // LANES):
                for lane in range(LANES):
                    rests[tile, block * LANES + lane] = abs(state[block * stride + lane])
                    lasts[tile, block * LANES + lane] = last[block * LANES + lane]
