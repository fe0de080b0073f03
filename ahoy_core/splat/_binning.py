"""Which Gaussians meet which tile, front to back: spatial packing, one stable depth sort, one counting sort by tile.

Records of visible Gaussians are stored in the order of the tile that holds their centre (their *slot*), so that a tile
reads a compact piece of memory even if the input is in no order. An intersection keeps the slot and a bit mask of the
4 x 4 pixel blocks that the Gaussian can reach, found by an exact ellipse-against-box test of sixteen blocks at once.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np

from ahoy_core.splat._jit import kernel
from ahoy_core.splat._powers import log2, sqrt
from ahoy_core.splat._simd import bits, fma, load, maximum, minimum, prefetch, splat, store
from ahoy_core.splat._vectors import LANES
from ahoy_core.splat.constants import SLACK

HEAD: Final = 8
"""Values of a record before its channels: mean (2), what rounding took from it (2), factors a, b, c, log2 opacity."""

_MAX_RADIX: Final = 2048


@kernel
def home_tile(x: float, y: float, tile_size: int, tiles_x: int, tiles_y: int) -> int:
    """Index of the tile nearest to an image position."""
    column = min(max(x / tile_size, 0.0), tiles_x - 1.0)
    row = min(max(y / tile_size, 0.0), tiles_y - 1.0)
    return int(row) * tiles_x + int(column)


@kernel
def count_homes(
    start: int, stop: int, radii: Any, means2d: Any, tile_size: int, tiles_x: int, tiles_y: int, counts: Any
) -> int:
    """Add the visible Gaussians of rows [start, stop) to their tiles' counts; returns how many there are."""
    visible = 0
    for i in range(start, stop):
        if radii[i, 0] > 0:
            counts[home_tile(means2d[i, 0], means2d[i, 1], tile_size, tiles_x, tiles_y)] += 1
            visible += 1
    return visible


@kernel
def to_offsets(counts: Any) -> Any:
    """Per-part counts [P,T] -> exclusive running sums in place, tile by tile, part by part; returns [T+1] starts."""
    parts, tiles = counts.shape
    starts = np.empty(tiles + 1, np.int64)
    total = 0
    for tile in range(tiles):
        starts[tile] = total
        for part in range(parts):
            here = counts[part, tile]
            counts[part, tile] = total
            total += here
    starts[tiles] = total
    return starts


@kernel
def pack_records(
    start: int, stop: int, first: int, radii: Any, means2d: Any, residuals: Any, factors: Any, opacities: Any,
    features: Any, order_keys: Any, tile_size: int, tiles_x: int, tiles_y: int, cursors: Any,
    records: Any, slots: Any, keys: Any, sequence: Any,
) -> None:  # fmt: skip
    """Write the records of rows [start, stop); sequence[first:] lists their slots in the order of the input."""
    channels, stride = features.shape[1], records.shape[1]
    levels, places = np.ones(LANES), np.empty(LANES, np.int64)
    for i in range(start, stop, LANES):
        count = min(LANES, stop - i)
        for lane in range(count):
            places[lane], levels[lane], row = -1, 1.0, i + lane
            if radii[row, 0] > 0:
                tile = home_tile(means2d[row, 0], means2d[row, 1], tile_size, tiles_x, tiles_y)
                places[lane], levels[lane] = cursors[tile], opacities[row]
                cursors[tile] += 1
                prefetch(records, places[lane] * stride)
                prefetch(records, (places[lane] + 1) * stride - 1)
        store(levels, 0, log2(load(levels, 0)))
        for lane in range(count):
            slot, row = places[lane], i + lane
            slots[row] = slot
            if slot < 0:
                continue
            keys[slot], sequence[first] = order_keys[row], slot
            first += 1
            for k in range(2):
                records[slot, k], records[slot, 2 + k] = means2d[row, k], residuals[row, k]
            for k in range(3):
                records[slot, 4 + k] = factors[row, k]
            records[slot, 7] = levels[lane]
            for k in range(channels):
                records[slot, HEAD + k] = features[row, k]
            for k in range(HEAD + channels, stride):
                records[slot, k] = 0.0


@kernel
def _settle_ties(keys: Any, sequence: Any, items: Any) -> None:
    """Order the runs whose cut keys tie by their whole keys, stably."""
    start, n = 0, len(sequence)
    for stop in range(1, n + 1):
        if stop < n and items[stop] >> np.uint64(32) == items[start] >> np.uint64(32):
            continue
        if stop - start > 1:
            run = sequence[start:stop].copy()
            order = np.argsort(keys[run], kind="mergesort")
            for k in range(stop - start):
                sequence[start + k] = run[order[k]]
        start = stop


@kernel
def sort_by_depth(keys: Any, sequence: Any) -> None:
    """Stable radix sort, in place, of the slots in sequence by their float64 keys; ties keep the order of the sequence.

    The keys' bits, taken relative to the smallest, are cut to the top 32 that vary, which three passes sort; runs that
    still tie are rare and are put in order afterwards.
    """
    n = len(sequence)
    if n == 0:
        return
    whole = keys.view(np.int64)
    low, high = np.int64(0x7FFFFFFFFFFFFFFF), np.int64(-0x7FFFFFFFFFFFFFFF)
    for slot in range(n):
        bits_of = whole[slot] ^ ((whole[slot] >> 63) & np.int64(0x7FFFFFFFFFFFFFFF))
        low, high = min(low, bits_of), max(high, bits_of)
    span, shift = np.uint64(high) - np.uint64(low), 0
    while (span >> np.uint64(shift)) > np.uint64(0xFFFFFFFF):
        shift += 1
    items, spare = np.empty(n, np.uint64), np.empty(n, np.uint64)
    for k in range(n):
        value = whole[sequence[k]]
        value ^= (value >> 63) & np.int64(0x7FFFFFFFFFFFFFFF)
        top = (np.uint64(value) - np.uint64(low)) >> np.uint64(shift)
        items[k] = (top << np.uint64(32)) | np.uint64(sequence[k])
    for place in (32, 43, 54):
        counts = np.zeros(_MAX_RADIX + 1, np.int64)
        for k in range(n):
            counts[np.int64((items[k] >> np.uint64(place)) & np.uint64(_MAX_RADIX - 1)) + 1] += 1
        for k in range(_MAX_RADIX):
            counts[k + 1] += counts[k]
        for k in range(n):
            digit = np.int64((items[k] >> np.uint64(place)) & np.uint64(_MAX_RADIX - 1))
            spare[counts[digit]] = items[k]
            counts[digit] += 1
        items, spare = spare, items
    for k in range(n):
        sequence[k] = np.int32(items[k] & np.uint64(0xFFFFFFFF))
    if shift > 0:
        _settle_ties(keys, sequence, items)


@kernel
def block_mask(records: Any, slot: int, grid: Any, group: int, x: float, y: float, shape: Any, limit: Any) -> Any:
    """Bits of the sixteen blocks, with corner offsets in grid, whose pixel centres the ellipse can reach.

    The quadratic's minimum over a box lies at the box's point nearest to the mean along one of the two axes, with the
    other coordinate free; shape holds the slopes of these two lines. x and y are the tile's corner.
    """
    a, b, c = splat(records[slot, 4]), splat(records[slot, 5]), splat(records[slot, 6])
    zero = a - a
    blocks = (grid.shape[0] - 32) // 2
    left = (load(grid, 32 + 16 * group) + x - records[slot, 0]) - records[slot, 2]
    top = (load(grid, 32 + blocks + 16 * group) + y - records[slot, 1]) - records[slot, 3]
    right, bottom = left + 3.0, top + 3.0
    dx, dy = maximum(left, minimum(right, zero)), maximum(top, minimum(bottom, zero))
    free_y = maximum(top, minimum(bottom, dx * shape[0]))
    free_x = maximum(left, minimum(right, dy * shape[1]))
    u, w = fma(a, dx, b * free_y), c * free_y
    first = fma(u, u, w * w)
    u, w = fma(a, free_x, b * dy), c * dy
    return bits(minimum(first, fma(u, u, w * w)) <= limit)


@kernel
def tile_span(center: float, reach: float, tile_size: int, tiles: int) -> tuple[int, int]:
    """First and last tile whose pixel centres lie within reach of an image coordinate (first > last: none)."""
    low = min(max(math.floor((center - reach - 0.5) / tile_size), 0.0), float(tiles))
    high = min(max(math.floor((center + reach - 0.5) / tile_size), -1.0), tiles - 1.0)
    return int(low), int(high)


@kernel
def _grown(array: Any) -> Any:
    """A copy with half as much room again."""
    bigger = np.empty(len(array) + len(array) // 2 + 16, array.dtype)
    bigger[: len(array)] = array
    return bigger


@kernel
def plan_search(k: int, count: int, order: Any, records: Any, log2_cutoff: float, scratch: Any) -> None:
    """Columns for order[k], ..., order[k + count - 1]: mean (2), reach (2), slopes (2) and limit of `block_mask`."""
    for lane in range(count):
        slot = order[k + lane]
        for axis in range(2):
            scratch[axis * LANES + lane] = float(records[slot, axis]) + float(records[slot, 2 + axis])
        for m in range(4):
            scratch[(2 + m) * LANES + lane] = records[slot, 4 + m]
    a, b, c = load(scratch, 2 * LANES), load(scratch, 3 * LANES), load(scratch, 4 * LANES)
    limit = maximum(load(scratch, 5 * LANES) - log2_cutoff, 0.0) * (1.0 + SLACK) + SLACK
    norm, inverse_a = b * b + c * c, 1.0 / a
    radius = sqrt(limit * (1.0 + SLACK)) / c
    store(scratch, 2 * LANES, radius * sqrt(norm) * inverse_a)
    store(scratch, 3 * LANES, radius)
    store(scratch, 4 * LANES, -a * b / norm)
    store(scratch, 5 * LANES, -b * inverse_a)
    store(scratch, 6 * LANES, limit)


@kernel
def find_tiles(
    start: int, stop: int, order: Any, records: Any, grid: Any, log2_cutoff: float, tile_size: int, tiles_x: int,
    tiles_y: int, budget: int, counts: Any, per_slot: Any, mask_like: Any,
) -> tuple[Any, Any, int]:  # fmt: skip
    """Tiles and block masks met by order[start:stop], Gaussian after Gaussian; counts them even beyond the budget."""
    room = 2 * (stop - start) + 16
    tiles, masks, found = np.empty(room, np.int32), np.empty(room, mask_like.dtype), 0
    groups = max(1, (tile_size // 4) ** 2 // 16)
    valid = np.uint64(0xF) if tile_size == 8 else np.uint64(0xFFFF)
    scratch = np.ones(7 * LANES)
    for k in range(start, stop):
        lane = (k - start) % LANES
        if lane == 0:
            for ahead in range(min(k + LANES, stop), min(k + 2 * LANES, stop)):
                prefetch(records, order[ahead] * records.shape[1])
                prefetch(records, order[ahead] * records.shape[1] + HEAD - 1)
            plan_search(k, min(LANES, stop - k), order, records, log2_cutoff, scratch)
        slot, before = order[k], found
        x0, x1 = tile_span(scratch[lane], scratch[2 * LANES + lane], tile_size, tiles_x)
        y0, y1 = tile_span(scratch[LANES + lane], scratch[3 * LANES + lane], tile_size, tiles_y)
        shape = (records.dtype.type(scratch[4 * LANES + lane]), records.dtype.type(scratch[5 * LANES + lane]))
        bound = splat(records.dtype.type(scratch[6 * LANES + lane]))
        for row in range(y0, y1 + 1):
            for column in range(x0, x1 + 1):
                mask = np.uint64(0)
                for group in range(groups):
                    part = block_mask(records, slot, grid, group, column * tile_size, row * tile_size, shape, bound)
                    mask |= (part & valid) << np.uint64(16 * group)
                if mask == np.uint64(0):
                    continue
                if found < budget:
                    if found == len(tiles):
                        tiles, masks = _grown(tiles), _grown(masks)
                    tiles[found], masks[found] = row * tiles_x + column, mask
                    counts[row * tiles_x + column] += 1
                found += 1
        per_slot[slot] = found - before
    return tiles, masks, found


@kernel
def fill_tiles(
    start: int, stop: int, order: Any, per_slot: Any, tiles: Any, masks: Any, cursors: Any, ids: Any, out_masks: Any
) -> None:
    """Counting sort: hand each intersection of order[start:stop] to its tile; the order by depth is kept."""
    at = 0
    for k in range(start, stop):
        slot = order[k]
        for _ in range(per_slot[slot]):
            place = cursors[tiles[at]]
            cursors[tiles[at]] += 1
            ids[place], out_masks[place] = slot, masks[at]
            at += 1
