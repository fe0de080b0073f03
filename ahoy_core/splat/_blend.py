"""Front-to-back blending of a tile's Gaussians, one 4 x 4 block of pixels per vector (Kerbl et al. 2023, eq. 2-3).

The state of a block is stored together (transmittance, alpha, then the channels), so a tile of 16 x 16 pixels and three
channels lives in 5 KB. Alpha is summed on its own, because 1 - transmittance has no digits left where it is faint. A
pixel is finished when its transmittance would fall to the stop; that is kept as its sign.
All arithmetic is relative to the block's corner, so the image does not depend on tile size or number of threads.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ahoy_core.splat._binning import HEAD
from ahoy_core.splat._channels import channel_blend, splat_channels
from ahoy_core.splat._jit import kernel
from ahoy_core.splat._powers import exp2
from ahoy_core.splat._simd import bits, fma, fnma, load, lowest_bit, maximum, minimum, prefetch, select, splat, store
from ahoy_core.splat._vectors import LANES

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
def block_corner(block: int, x: int, y: int, side: int) -> tuple[int, int]:
    """First column and row of a block, in a tile of side x side blocks at (x, y)."""
    return x + block % side * 4, y + block // side * 4


@kernel
def start_tile(x: int, y: int, width: int, height: int, side: int, stride: int, state: Any, last: Any) -> Any:
    """Reset a tile's state: transmittance 1 inside the image, 0 outside. Returns the bits of blocks inside."""
    alive = np.uint64(0)
    zero = splat(state.dtype.type(0.0))
    none = splat(np.int32(-1))
    for block in range(side * side):
        left, top = block_corner(block, x, y, side)
        base, columns, rows = block * stride, min(4, width - left), min(4, height - top)
        for k in range(1, stride // LANES):
            store(state, base + k * LANES, zero)
        store(last, block * LANES, none)
        store(state, base, zero + state.dtype.type(1.0) if columns == 4 and rows == 4 else zero)
        if columns > 0 and rows > 0:
            alive |= np.uint64(1) << np.uint64(block)
            if columns < 4 or rows < 4:
                for row in range(rows):
                    for column in range(columns):
                        state[base + 4 * row + column] = 1.0
    return alive


@kernel
def finish_tile(
    tile: int, side: int, background: Any, like: Any, state: Any, last: Any, rests: Any, lasts: Any
) -> None:
    """Put the background behind a tile's channels; keep transmittance and last rank if rests has rows."""
    stride = (2 + len(like)) * LANES
    behind = splat_channels(background, 0, like)
    for block in range(side * side):
        before = load(state, block * stride)
        rest = maximum(before, -before)
        channel_blend(behind, rest, state, block * stride + 2 * LANES)
        if rests.shape[0] > 0:
            store(rests, tile * rests.shape[1] + block * LANES, rest)
            for lane in range(LANES):
                lasts[tile, block * LANES + lane] = last[block * LANES + lane]


@kernel
def write_tile(x: int, y: int, side: int, like: Any, state: Any, image: Any, alphas: Any) -> None:
    """Copy a tile's blocks into the image [H,W,D] and the alphas [H,W,1]."""
    height, width, channels = image.shape
    stride = (2 + len(like)) * LANES
    for block in range(side * side):
        left, top = block_corner(block, x, y, side)
        base = block * stride + LANES
        for row in range(min(4, height - top)):
            for column in range(min(4, width - left)):
                lane = 4 * row + column
                alphas[top + row, left + column, 0] = state[base + lane]
                for k in range(len(like)):
                    if k < channels:
                        image[top + row, left + column, k] = state[base + (k + 1) * LANES + lane]


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
    tiles_x, side = (width + tile_size - 1) // tile_size, tile_size // 4
    stride, last = (2 + len(like)) * LANES, np.empty(side * side * LANES, np.int32)
    for tile in range(part, len(starts) - 1, parts):
        x, y = tile % tiles_x * tile_size, tile // tiles_x * tile_size
        alive = start_tile(x, y, width, height, side, stride, state, last)
        blend_tile(
            starts[tile], starts[tile + 1], ids, masks, records, grid, x, y, alive, like, limits, state, last, offsets
        )
        finish_tile(tile, side, background, like, state, last, rests, lasts)
        write_tile(x, y, side, like, state, image, alphas)
