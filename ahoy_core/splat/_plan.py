"""The work list of one camera: records of what is visible and, tile by tile, who meets it front to back."""

from __future__ import annotations

import functools
import os
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ahoy_core.splat import _binning as binning
from ahoy_core.splat._threads import run_parts, split
from ahoy_core.splat.constants import CHANNEL_COUNTS

Array = NDArray[Any]


@dataclass(frozen=True)
class Tiling:
    """How an image is cut: tiles of 8, 16 or 32 pixels, blocks of 4."""

    width: int
    height: int
    tile_size: int

    @property
    def tiles_x(self) -> int:
        """Tiles in a row."""
        return -(-self.width // self.tile_size)

    @property
    def tiles_y(self) -> int:
        """Rows of tiles."""
        return -(-self.height // self.tile_size)

    @functools.lru_cache(maxsize=64)  # noqa: B019
    def grid(self, dtype: Any) -> Array:
        """Pixel of each lane in its block (x then y), then the first pixel centre of each block in its tile.

        A tile of 8 has four blocks; the other twelve of its vector lie far outside every image.
        """
        lanes, side = np.arange(16), self.tile_size // 4
        blocks = np.arange(max(16, side * side))
        x, y = blocks % side * 4 + 0.5, blocks // side * 4 + 0.5
        outside = blocks >= side * side
        x[outside], y[outside] = 2.0**22 + 0.5, 2.0**22 + 0.5
        return np.concatenate([lanes % 4, lanes // 4, x, y]).astype(dtype)

    @property
    def mask_dtype(self) -> Any:
        """Integer with a bit for every block of a tile."""
        return np.uint64 if self.tile_size == 32 else np.uint16


@dataclass(frozen=True)
class Plan:
    """Slots 0..M-1 are the visible Gaussians by tile; intersections are sorted by tile, then by depth."""

    records: Array  # [M,R] see _binning.HEAD, then the channels, padded
    slots: Array  # [N] slot of each row of the input, -1 if not visible
    starts: Array  # [T+1] first intersection of each tile
    ids: Array  # [I] slot
    masks: Array  # [I] blocks of the tile that may be touched

    def owners(self) -> Array:
        """Row of the input of each slot, [M]."""
        rows = np.flatnonzero(self.slots >= 0).astype(np.int32)
        owners = np.empty(len(self.records), np.int32)
        owners[self.slots[rows]] = rows
        return owners

    def tiles_per_gauss(self) -> Array:
        """Tiles met by each row of the input, [N]."""
        counts = np.zeros(len(self.slots), np.int32)
        counts[self.owners()] = np.bincount(self.ids, minlength=len(self.records))
        return counts


def padded_channels(channels: int) -> int:
    """The number of channels that kernels are compiled for."""
    return next(count for count in CHANNEL_COUNTS if count >= channels)


def default_budget() -> int:
    """Half of the machine's memory in bytes (4 GB where the system does not say)."""
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2
    except (AttributeError, ValueError, OSError):
        return 1 << 32


def intersection_bytes(tiling: Tiling) -> int:
    """Bytes held per intersection while they are found and sorted: tile, slot and two masks, with room to grow."""
    mask = np.dtype(tiling.mask_dtype).itemsize
    return 4 + mask + (4 + mask) * 3 // 2


def make_plan(
    tiling: Tiling, projected: list[Array], features: Array, order_keys: Array, log2_cutoff: float, budget: int,
    threads: int,
) -> Plan:  # fmt: skip
    """Pack, sort and tile one camera's Gaussians: projected are radii, means2d, residuals, factors and opacities.

    Raises:
        MemoryError: If the intersections would take more than budget bytes; nothing of that size was allocated.
    """
    size, tx, ty = tiling.tile_size, tiling.tiles_x, tiling.tiles_y
    radii, means2d = projected[:2]
    spans = split(len(radii), threads)
    homes = np.zeros((len(spans), tx * ty), np.int64)
    visible = run_parts(lambda p: binning.count_homes(*spans[p], radii, means2d, size, tx, ty, homes[p]), len(spans))
    binning.to_offsets(homes)
    first, total = np.concatenate([[0], np.cumsum(visible)]), sum(visible)
    stride = binning.HEAD + padded_channels(features.shape[1])
    records = np.empty((total, stride), features.dtype)
    sequence, slots, keys = np.empty(total, np.int32), np.empty(len(radii), np.int32), np.empty(total)
    run_parts(
        lambda p: binning.pack_records(
            *spans[p], first[p], *projected, features, order_keys, size, tx, ty,
            homes[p], records, slots, keys, sequence,
        ),
        len(spans),
    )  # fmt: skip
    binning.sort_by_depth(keys, sequence)
    return Plan(records, slots, *_intersect(tiling, sequence, records, log2_cutoff, budget, threads))


def _intersect(
    tiling: Tiling, order: Array, records: Array, log2_cutoff: float, budget: int, threads: int
) -> tuple[Array, Array, Array]:
    """First intersections [T+1], ids [I] and masks [I], given the slots in the order of depth."""
    spans = split(len(order), threads)
    parts, tiles = len(spans), tiling.tiles_x * tiling.tiles_y
    counts, per_slot = np.zeros((parts, tiles), np.int64), np.empty(len(order), np.int32)
    grid, mask_like = tiling.grid(records.dtype), np.empty(0, tiling.mask_dtype)
    allowed = budget // intersection_bytes(tiling)

    def find(part: int, room: int) -> tuple[Array, Array, int]:
        return binning.find_tiles(
            *spans[part], order, records, grid, log2_cutoff, tiling.tile_size, tiling.tiles_x, tiling.tiles_y, room,
            counts[part], per_slot, mask_like,
        )  # fmt: skip

    found = run_parts(lambda p: find(p, allowed // parts), parts)
    total = sum(item[2] for item in found)
    if total > allowed:
        raise MemoryError(
            f"memory_budget: expected at most {budget} bytes for intersections, got {total} intersections of Gaussians "
            f"and tiles, {total * intersection_bytes(tiling)} bytes; raise memory_budget, or lower the scales, "
            "the resolution or the number of Gaussians"
        )
    for part, item in enumerate(found):
        if item[2] > allowed // parts:
            counts[part] = 0
            found[part] = find(part, item[2])
    starts = binning.to_offsets(counts)
    ids, masks = np.empty(total, np.int32), np.empty(total, tiling.mask_dtype)
    run_parts(lambda p: binning.fill_tiles(*spans[p], order, per_slot, *found[p][:2], counts[p], ids, masks), parts)
    return starts, ids, masks
