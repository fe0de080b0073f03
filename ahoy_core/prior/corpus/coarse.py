"""Imitates a coarse avatar: what one or two views saw, spread over the rest of the person the way a fill does it."""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

_SAME_SURFACE = 0.02  # metres between a point and the observed depth at its pixel
_BANDS = 12


class View(NamedTuple):
    """One frame at the person image's size, sampled once a pixel.

    Attributes:
        pixels: [N] covered ones.
        corners: [N,3] vertices of the triangle that each sees.
        bary: [N,3] their weights.
        material: [N].
        height: [N] metres, rest space.
        screen: [V,3] pixel u, v (of the person image) and depth of all vertices in this frame.
        depth: [H,W].
        colour: [H,W,3] the frame in [0,1].
        occluded: [H,W] bool: something stands in front of the person here.
    """

    pixels: Array
    corners: Array
    bary: Array
    material: Array
    height: Array
    screen: Array
    depth: Array
    colour: Array
    occluded: Array


def random_occluder(rng: np.random.Generator, height: int, width: int) -> Array:
    """A mask [H,W] of something in front of the person: a desk below a row, a post, a box; or nothing."""
    mask = np.zeros((height, width), dtype=bool)
    kind = rng.choice(["none", "desk", "post", "box"], p=[0.4, 0.35, 0.1, 0.15])
    if kind == "desk":
        mask[int(height * rng.uniform(0.4, 0.85)) :] = True
    elif kind == "post":
        left = int(width * rng.uniform(0.1, 0.7))
        mask[:, left : left + int(width * rng.uniform(0.1, 0.3))] = True
    elif kind == "box":
        top, left = int(height * rng.uniform(0.2, 0.7)), int(width * rng.uniform(0, 0.6))
        mask[top : top + int(height * rng.uniform(0.1, 0.4)), left : left + int(width * rng.uniform(0.3, 0.8))] = True
    return mask


def coarse_frames(views: list[View], observed: list[int], rng: np.random.Generator, grey: float) -> tuple[Array, Array]:
    """Coarse pictures [T,H,W,3] in [0,1] over grey, and what of them was observed [T,H,W] in [0,1].

    Args:
        views: T frames.
        observed: frames that the imagined video showed (behind their occluders).
        rng: source of every draw.
        grey: of the background.
    """
    size = views[0].depth.shape
    bands = _band_colours(views, observed)
    through = rng.random() < 0.6
    sigma = float(rng.uniform(0.3, 1.4))
    pictures = np.full((len(views), *size, 3), grey, dtype=np.float32)
    coverage = np.zeros((len(views), *size), dtype=np.float32)
    for t, view in enumerate(views):
        colour, seen = _band_lookup(view, bands), np.zeros(len(view.pixels), dtype=bool)
        for k in reversed(observed):
            source = views[k]
            row, column, depth = _landing(view, source, size)
            there = np.isfinite(source.depth[row, column]) & ~source.occluded[row, column]
            visible = there & (depth < source.depth[row, column] + _SAME_SURFACE)
            used = visible | (there & ~seen & through)
            colour[used] = source.colour[row[used], column[used]]
            seen |= visible
        pictures[t].reshape(-1, 3)[view.pixels] = colour
        coverage[t].reshape(-1)[view.pixels] = seen
        pictures[t] = _degraded(pictures[t], view, coverage[t], sigma, rng, grey)
    return pictures, coverage


def _landing(view: View, source: View, size: tuple[int, ...]) -> tuple[Array, Array, Array]:
    """Rows, columns and depths at which a view's points land in a source frame."""
    point = (source.screen[view.corners] * view.bary[..., None]).sum(1)
    row = np.clip(np.floor(point[:, 1]).astype(np.int64), 0, size[0] - 1)
    column = np.clip(np.floor(point[:, 0]).astype(np.int64), 0, size[1] - 1)
    return row, column, point[:, 2]


def _band(view: View) -> Array:
    return np.clip((view.height + 0.9) / 1.8 * _BANDS, 0, _BANDS - 1).astype(np.int64)


def _band_colours(views: list[View], observed: list[int]) -> Array:
    """Mean observed colour by material and height [M,BANDS,3]; empty bands take their nearest neighbour's."""
    total, count = np.zeros((8, _BANDS, 4)), np.zeros((8, _BANDS, 1))
    for k in observed:
        view = views[k]
        shown = ~view.occluded.ravel()[view.pixels]
        keys = view.material[shown], _band(view)[shown]
        np.add.at(total[..., :3], keys, view.colour.reshape(-1, 3)[view.pixels[shown]])
        np.add.at(count, keys, 1.0)
    known = count[..., 0] > 3
    if not known.any():
        return np.full((8, _BANDS, 3), 0.5)
    mean = total[..., :3] / np.maximum(count, 1)
    rows, columns = np.nonzero(known)
    filled = mean.copy()
    for m in range(8):
        for b in range(_BANDS):
            if not known[m, b]:
                # A fill knows places, not materials: across materials only height counts.
                nearest = np.argmin(np.abs(columns - b) + 0.4 * (rows != m))
                filled[m, b] = mean[rows[nearest], columns[nearest]]
    return filled


def _band_lookup(view: View, bands: Array) -> Array:
    return bands[view.material, _band(view)].astype(np.float32)


def _degraded(
    picture: Array, view: View, coverage: Array, sigma: float, rng: np.random.Generator, grey: float
) -> Array:
    """Blur, most where nothing was observed, and a few blotches there, within the silhouette."""
    inside = np.zeros(picture.shape[:2], dtype=np.float32)
    inside.reshape(-1)[view.pixels] = 1
    blurred = cv2.GaussianBlur(picture, (0, 0), sigma + 0.8)
    soft = cv2.GaussianBlur(picture, (0, 0), sigma)
    mixed = np.where(coverage[..., None] > 0, soft, blurred)
    for _ in range(int(rng.integers(0, 4))):
        y, x = int(rng.integers(8, picture.shape[0] - 8)), int(rng.integers(8, picture.shape[1] - 8))
        blob = np.zeros(picture.shape[:2], dtype=np.float32)
        cv2.ellipse(blob, (x, y), (int(rng.integers(2, 7)), int(rng.integers(2, 9))), 0, 0, 360, 1.0, -1)
        blob = cv2.GaussianBlur(blob, (0, 0), 1.0)[..., None] * (coverage[..., None] == 0) * rng.uniform(0.2, 0.8)
        mixed = mixed * (1 - blob) + blob * rng.uniform(0, 1, 3).astype(np.float32)
    edge = cv2.GaussianBlur(inside, (0, 0), 0.5)[..., None]
    return mixed * edge + grey * (1 - edge)
