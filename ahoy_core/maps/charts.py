"""Orthographic views of the canonical body as charts: surface samples on a pixel grid, and room for them in the maps.

A front and a back view (paper section 3.1) never see soles, crotch, inner arms and whatever lies in front of
something else, and see sides at a glancing angle. So further views (left, right, below, above, then what lies behind
the first hit of all six) contribute the pixels that the earlier ones left uncovered; they are packed into the empty
part of the front and back maps. Every map pixel still holds at most one Gaussian and every Gaussian has one map
pixel.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

FloatArray = NDArray[np.floating]
IntArray = NDArray[np.integer]
BoolArray = NDArray[np.bool_]

# A ray goes on this far behind a hit: beyond float32 rounding at human size, within the thinnest fold worth a Gaussian.
STEP = 2e-4
# Hits looked for along one ray: arm, trunk, arm in a side view, front and back of each.
MAX_HITS = 8

VIEWS: dict[str, tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]] = {
    "front": ((0, 1, 0), (1, 0, 0), (0, 0, -1)),
    "back": ((0, -1, 0), (1, 0, 0), (0, 0, -1)),
    "left": ((-1, 0, 0), (0, 1, 0), (0, 0, -1)),
    "right": ((1, 0, 0), (0, 1, 0), (0, 0, -1)),
    "below": ((0, 0, 1), (1, 0, 0), (0, 1, 0)),
    "above": ((0, 0, -1), (1, 0, 0), (0, 1, 0)),
}
"""Ray direction, column axis and row axis of each view, world axes; front and back share their pixel grid."""


@dataclass(frozen=True)
class Chart:
    """Surface samples of one view and one layer, on its own pixel grid.

    rows, cols [M] int (non-negative), points [M,3] metres, faces [M] int, bary [M,3], rays [M,3] unit directions
    along which they were found.
    """

    rows: IntArray
    cols: IntArray
    points: FloatArray
    faces: IntArray
    bary: FloatArray
    rays: FloatArray

    def select(self, keep: BoolArray | IntArray) -> Chart:
        """The chosen samples, on the same grid."""
        rows, cols, points = self.rows[keep], self.cols[keep], self.points[keep]
        return Chart(rows, cols, points, self.faces[keep], self.bary[keep], self.rays[keep])

    def __len__(self) -> int:
        return len(self.rows)


@dataclass(frozen=True)
class Surface:
    """Triangles to sample.

    vertices [V,3] metres, faces [F,3] vertex indices, normals [F,3] outward unit normals, areas [F] m².
    """

    vertices: FloatArray
    faces: IntArray
    normals: FloatArray
    areas: FloatArray

    @classmethod
    def of(cls, vertices: FloatArray, faces: IntArray) -> Surface:
        """Compute normals and areas."""
        a, b, c = (vertices[faces[:, i]].astype(np.float64) for i in range(3))
        cross = np.cross(b - a, c - a)
        double = np.linalg.norm(cross, axis=1)
        return cls(vertices, faces, cross / np.maximum(double, 1e-20)[:, None], double / 2)

    def at(self, faces: IntArray, bary: FloatArray) -> FloatArray:
        """Points [M,3] at barycentric coordinates [M,3] of faces [M]."""
        return (self.vertices[self.faces[faces]] * bary[:, :, None]).sum(1)


def view_charts(surface: Surface, view: str, pitch: float) -> list[Chart]:
    """Outward-facing hits of one orthographic view, nearest layer first.

    Args:
        surface: The body in the canonical pose.
        view: A name of `VIEWS`.
        pitch: Distance of neighbouring rays, metres.

    Returns:
        One chart per layer, at least one; hits on the inside of the surface are left out and do not count as a layer.
    """
    direction, right, down = (np.asarray(axis, dtype=np.float64) for axis in VIEWS[view])
    u, v, depth = (surface.vertices @ axis for axis in (right, down, direction))
    cols, rows = (np.arange(int(np.ceil((w.max() - w.min()) / pitch)) + 1) for w in (u, v))
    grid_r, grid_c = (g.ravel() for g in np.meshgrid(rows, cols, indexing="ij"))
    # The grid is centred on the body's box, so that a symmetric body gets a symmetric map.
    start_u, start_v = (u.min() + u.max() - pitch * cols[-1]) / 2, (v.min() + v.max() - pitch * rows[-1]) / 2
    origins = (start_u + pitch * grid_c)[:, None] * right + (start_v + pitch * grid_r)[:, None] * down
    origins += (depth.min() - 0.1) * direction
    charts = []
    for ray, face, bary in _outward_layers(surface, origins, direction):
        along = np.broadcast_to(direction, (len(ray), 3))
        charts.append(Chart(grid_r[ray], grid_c[ray], surface.at(face, bary), face, bary, along))
    return charts


def _outward_layers(
    surface: Surface, origins: FloatArray, direction: FloatArray
) -> list[tuple[IntArray, IntArray, FloatArray]]:
    """(ray, face, barycentric coordinates) of the first, second, ... hit on the outside along parallel rays."""
    scene = EmbreeScene()
    mesh = TriangleMesh(scene, surface.vertices.astype(np.float32), surface.faces.astype(np.int32))
    origins, alive = origins.copy(), np.arange(len(origins))
    layer = np.zeros(len(origins), dtype=np.int64)
    found = [(np.zeros((0, 3), dtype=np.int64), np.zeros((0, 3)))]
    for _ in range(MAX_HITS):
        towards = np.broadcast_to(direction.astype(np.float32), (len(alive), 3)).copy()
        hits = scene.run(origins[alive].astype(np.float32), towards, output=1)
        hit = hits["primID"] >= 0
        alive, face, u, v = alive[hit], hits["primID"][hit].astype(np.int64), hits["u"][hit], hits["v"][hit]
        if len(alive) == 0:
            break
        origins[alive] += (hits["tfar"][hit].astype(np.float64)[:, None] + STEP) * direction
        out = surface.normals[face] @ direction < 0
        bary = np.stack([1 - u - v, u, v], 1).astype(np.float64)
        found.append((np.stack([alive, face, layer[alive]], 1)[out], bary[out]))
        layer[alive[out]] += 1
    del mesh
    index, bary = (np.concatenate(parts) for parts in zip(*found, strict=True))
    layers = [index[:, 2] == number for number in range(max(1, int(layer.max())))]
    return [(index[own, 0], index[own, 1], bary[own]) for own in layers]


def scattered(surface: Surface, faces: IntArray, bary: FloatArray) -> Chart:
    """Points of the surface as a chart of rows of 32, from the head down: for what no view has on its grid."""
    points = surface.at(faces, bary)
    order = np.lexsort((points[:, 0], -np.round(points[:, 2], 2)))
    number = np.arange(len(order))
    rays = -surface.normals[faces[order]]
    return Chart(number // 32, number % 32, points[order], faces[order], bary[order], rays)


class Packer:
    """The pixels of the maps that are still free, and a place for each chart.

    Args:
        sides: Number of maps.
        size: Their side in pixels.
    """

    def __init__(self, sides: int, size: int) -> None:
        self.taken = np.zeros((sides, size, size), dtype=bool)

    @property
    def free(self) -> int:
        """Pixels that are not taken."""
        return int((~self.taken).sum())

    def put(self, chart: Chart, side: int, row: int, col: int) -> IntArray:
        """Place a chart with its grid's origin at (row, col) of a map.

        Returns:
            [M,3] (side, row, column) of each sample.

        Raises:
            ValueError: If a pixel is taken or outside the map.
        """
        pixels = np.stack([np.full(len(chart), side), chart.rows + row, chart.cols + col], 1)
        if (pixels < 0).any() or (pixels[:, 1:] >= self.taken.shape[1]).any() or self.taken[tuple(pixels.T)].any():
            raise ValueError("expected free pixels inside the map, got taken ones or some outside; use `fit`")
        self.taken[tuple(pixels.T)] = True
        return pixels

    def fit(self, chart: Chart) -> IntArray:
        """Place a chart where it fits as a whole, else in halves, down to single pixels.

        Returns:
            [M,3] (side, row, column) of each sample; -1 where all pixels are taken.
        """
        pixels = np.full((len(chart), 3), -1, dtype=np.int64)
        queue = [np.arange(len(chart))] if len(chart) else []
        while queue and self.free:
            part = queue.pop(0)
            rows, cols = chart.rows[part], chart.cols[part]
            place = self._place(rows - rows.min(), cols - cols.min())
            if place is not None:
                side, row, col = place
                pixels[part] = self.put(chart.select(part), side, row - int(rows.min()), col - int(cols.min()))
                continue
            values = rows if np.ptp(rows) >= np.ptp(cols) else cols
            low = values <= (values.min() + values.max()) // 2
            queue[:0] = [half for half in (part[low], part[~low]) if len(half)]
        return pixels

    def _place(self, rows: IntArray, cols: IntArray) -> tuple[int, int, int] | None:
        height, width = int(rows.max()) + 1, int(cols.max()) + 1
        if max(height, width) > self.taken.shape[1]:
            return None
        stamp = np.zeros((height, width), dtype=np.float32)
        stamp[rows, cols] = 1
        for side, taken in enumerate(self.taken):
            overlap = cv2.matchTemplate(taken.astype(np.float32), stamp, cv2.TM_CCORR)
            spots = np.argwhere(overlap < 0.5)
            if len(spots):
                return side, int(spots[0][0]), int(spots[0][1])
        return None
