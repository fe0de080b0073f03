"""DensePose's word on the surface (paper section 3.1): which limb a pixel shows, and with its table, which point of it.

A table gives each chart coordinate a point of our body's surface. Where the fitted body has that point elsewhere in the
frame, the frame is moved there before it is read, so that colours land where DensePose sees them. What moves is smooth
and bounded: single wrong pixels of the network do not tear a texture.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ahoy_core.formats.densepose import CHARTS, ChartTable
from ahoy_core.models.densepose import PARTS as DENSE_PARTS
from ahoy_core.texture.rays import Caster, face_normals, to_pixels, view_cosines
from ahoy_core.texture.surface import (
    ARM,
    HALF_ALPHA,
    LEG,
    PARTS,
    REFERENCE_HEIGHT,
    SeenFrame,
    Surface,
    height_in_pixels,
)
from ahoy_core.texture.texels import pad_charts, texel_map

REACH: Final = 5.0  # pixels of a body 200 pixels tall by which DensePose and the fit may disagree on where a limb ends
FURTHEST: Final = 16.0  # likewise: a point that the fit has further away than this is a mistake of one of both
SPREAD: Final = 5.0  # likewise: over how many pixels the frame moves as one
GRID: Final = 96  # cells along a chart's sides: under a centimetre of the largest chart
SAMPLES: Final = 512  # texels a side that stand for our surface: three to four millimetres apart
NORMAL_M: Final = 0.05  # metres that a quarter turn of the normal counts for: keeps front and back of a hand apart
_LIMB_WORDS = {ARM: "arm", LEG: "leg"}
_PART_WORDS = {"head": "head", "hands": "hand", "feet": "foot"}

Array = NDArray[Any]


@dataclass(frozen=True)
class ChartMap:
    """Points of our body's surface for DensePose's chart coordinates.

    Attributes:
        face: [24,GRID,GRID] by chart, v and u.
        bary: [24,GRID,GRID,3].
    """

    face: Array
    bary: Array

    def points(self, chart: Array, uv: Array) -> tuple[Array, Array]:
        """Faces [N] and weights [N,3] of chart coordinates: chart [N] 1 to 24, uv [N,2] in [0,1]."""
        cell = np.clip((np.asarray(uv, np.float32) * GRID).astype(np.int64), 0, GRID - 1)
        where = np.asarray(chart, np.int64) - 1, cell[:, 1], cell[:, 0]
        return self.face[where], self.bary[where]


def chart_map(table: ChartTable, placed: Array, surface: Surface, rest: Array) -> ChartMap:
    """Look every cell of every chart up on our body.

    Args:
        table: DensePose's charts on the SMPL mesh.
        placed: [V,3] SMPL's vertices where our body rests (`ahoy_core.body.register.vertices_on`).
        surface: our body's triangles.
        rest: [V',3] our body's vertices at rest.
    """
    aside = np.zeros(len(table.vertices))
    aside[table.faces] = 2.0 * table.chart[:, None]
    flat = np.stack([table.uv[:, 0] + aside, table.uv[:, 1], np.zeros(len(aside))], 1)
    rows, cols = np.mgrid[0:GRID, 0:GRID]
    cells = np.stack([(cols.ravel() + 0.5) / GRID, (rows.ravel() + 0.5) / GRID, np.zeros(GRID**2)], 1)
    there = cells[None] + np.array([2.0, 0, 0]) * np.arange(1, CHARTS + 1)[:, None, None]
    hits = Caster(flat, table.faces, "ortho").cast(there.reshape(-1, 3))
    corners = table.vertices[table.faces]
    normals = face_normals(placed, corners)
    found = hits.face >= 0
    values: Array = np.zeros((len(found), 6), np.float32)
    values[found, :3] = (placed[corners[hits.face[found]]] * hits.bary[found, :, None]).sum(1)
    values[found, 3:] = NORMAL_M * normals[hits.face[found]]
    cut = (CHARTS, GRID, GRID)
    padded = np.stack(
        [pad_charts(v, known) for v, known in zip(values.reshape(*cut, 6), found.reshape(cut), strict=True)]
    )
    samples = texel_map(surface, SAMPLES)
    outward = NORMAL_M * face_normals(rest, surface.faces)[samples.face]
    ours = np.concatenate([samples.points(rest, surface.faces), outward], 1)
    _, nearest = cKDTree(ours).query(padded.reshape(-1, 6))
    return ChartMap(samples.face[nearest].reshape(cut), samples.bary[nearest].reshape(*cut, 3))


@dataclass(frozen=True)
class DenseSurface:
    """What DensePose says of a clip's T frames, for `ahoy_core.texture.accumulate`.

    Attributes:
        surface: our body's triangles.
        parts: [T,H,W] uint8 of the subject, 0 to 24.
        uv: [T,H,W,2] uint8, 255 is 1.
        charts: where they lie on our body; None: only limbs are compared.
        moved: by frame number, filled as frames are read: mean distance in pixels that the person was moved by.
        labels: likewise: the parts, moved as the frame was.
    """

    surface: Surface
    parts: Array
    uv: Array
    charts: ChartMap | None = None
    moved: dict[int, float] = field(default_factory=dict)
    labels: dict[int, Array] = field(default_factory=dict)

    def registered(self, number: int, caster: Caster, K: Array, image: Array, visible: Array) -> tuple[Array, Array]:
        """A frame [H,W,3] and its mask [H,W], moved: the fitted body's points show what DensePose sees of them."""
        flow = self._flow(number, caster, K, visible)
        if flow is None:
            return image, visible
        height, width = visible.shape
        grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).astype(np.float32) + flow
        x, y = np.ascontiguousarray(grid[..., 0]), np.ascontiguousarray(grid[..., 1])
        linear, edge = cv2.INTER_LINEAR, cv2.BORDER_REPLICATE
        moved = [cv2.remap(picture, x, y, linear, borderMode=edge) for picture in (image, visible)]
        inside = visible >= HALF_ALPHA
        self.labels[number] = cv2.remap(self.parts[number], x, y, cv2.INTER_NEAREST)
        self.moved[number] = float(np.linalg.norm(flow[inside], axis=1).mean()) if inside.any() else 0.0
        return moved[0], moved[1]

    def checked(self, number: int, seen: SeenFrame) -> SeenFrame:
        """What a frame's trust becomes where DensePose sees another limb than the fitted body has there."""
        size = 2 * max(1, round(REACH * height_in_pixels(seen.hits) / REFERENCE_HEIGHT)) + 1
        near = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
        said = np.array(DENSE_PARTS)[self.labels.get(number, self.parts[number])]
        of_face = words_of_faces(self.surface)
        agreed = np.zeros(seen.valid.shape, dtype=bool)
        for word in {*_PART_WORDS.values(), *_LIMB_WORDS.values(), "torso"}:
            around = cv2.dilate((said == word).astype(np.uint8), near) > 0
            agreed |= around & (of_face[seen.hits.face] == word)
        return replace(seen, valid=seen.valid & agreed)

    def _flow(self, number: int, caster: Caster, K: Array, visible: Array) -> Array | None:
        """[H,W,2] pixels: where in the frame the fitted body's points are seen, less where the fit has them."""
        if self.charts is None:
            return None
        rows, cols = np.nonzero((self.parts[number] > 0) & (visible >= HALF_ALPHA))
        if len(rows) == 0:
            return None
        face, bary = self.charts.points(self.parts[number][rows, cols], self.uv[number][rows, cols] / 255)
        points = (caster.vertices[caster.faces[face]] * bary[:, :, None]).sum(1)
        fitted = to_pixels(points, K, caster.camera_model)
        shift = np.stack([cols, rows], 1) + 0.5 - fitted
        scale = (rows.max() - rows.min() + 1) / REFERENCE_HEIGHT
        height, width = visible.shape
        with np.errstate(invalid="ignore"):
            kept = (np.linalg.norm(shift, axis=1) <= FURTHEST * scale) & (fitted >= 0).all(1)
            kept &= (fitted[:, 0] < width) & (fitted[:, 1] < height)
        kept &= view_cosines(points, caster.normals[face], caster.camera_model) > 0
        kept[kept] = caster.sees(points[kept], face[kept])
        cell = np.floor(fitted[kept]).astype(np.int64)
        said = np.zeros((height, width, 3), np.float32)
        np.add.at(said, (cell[:, 1], cell[:, 0]), np.concatenate([shift[kept], np.ones((len(cell), 1))], 1))
        total: Array = cv2.GaussianBlur(said, (0, 0), max(SPREAD * scale, 0.5))
        # A pixel that a twentieth of its surroundings speaks for moves by half of what they say; beyond, nothing moves.
        flow: Array = total[..., :2] / (total[..., 2:] + 0.05)
        return flow


def words_of_faces(surface: Surface) -> Array:
    """[F] what DensePose would call each triangle."""
    limbs = surface.limb[surface.faces]
    most = np.where(limbs[:, 1] == limbs[:, 2], limbs[:, 1], limbs[:, 0])
    words = np.array([_LIMB_WORDS.get(limb, "torso") for limb in range(3)])[most]
    for number, part in enumerate(PARTS):
        if part in _PART_WORDS:
            words[surface.part == number] = _PART_WORDS[part]
    return words
