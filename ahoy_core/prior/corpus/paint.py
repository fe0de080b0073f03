"""Colours of a person's materials: balanced tints, procedural patterns, prints on chest and back, and a plain face.

Each material is a row of numbers, so that the shader (`shade`) is one loop in machine code.
"""

from __future__ import annotations

import colorsys
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ahoy_core.prior.corpus.dress import KINDS, Dressed, Kind

Array = NDArray[Any]

# Columns of a material's row.
KEEP, TINT, GREYNESS, PATTERN, PATTERN_TINT, FREQUENCY, PHASE, DUTY, GRAIN, PRINTS = 0, 1, 4, 5, 6, 9, 10, 11, 12, 13
PRINT_WIDTH: Final = 8  # kind, side, x, z, size, red, green, blue
COLUMNS: Final = PRINTS + 2 * PRINT_WIDTH

PLAIN, STRIPES, COLUMNS_PATTERN, CHECKS, DOTS, GRADIENT, BLOCK, PANELS = range(8)
NO_PRINT, DISC, BOX, BAR, CROSS, RING, LETTERS = range(7)

_PATTERN_SHARES = (0.52, 0.12, 0.06, 0.08, 0.04, 0.06, 0.08, 0.04)
_PRINT_SHARE = {-1: 0.3, 1: 0.12}  # front (-y) and back
_TEXTURE_KEPT = 0.3  # share of textured garments in their own colours


def random_paint(rng: np.random.Generator, person: Dressed, chest: float) -> Array:
    """Rows [len(KINDS),COLUMNS] of float32 for a person.

    Args:
        rng: source of every draw.
        person: whose textures say how bright they are by themselves.
        chest: metres, rest space: height of the shoulders, below which prints go.
    """
    rows = np.zeros((len(KINDS), COLUMNS), dtype=np.float32)
    hair = _hair_colour(rng)
    for k, kind in enumerate(KINDS):
        row = rows[k]
        row[GREYNESS] = person.greyness[k]
        row[TINT : TINT + 3] = _tint(rng, kind, hair)
        row[GRAIN] = rng.uniform(0.0, 0.05) if kind in ("upper", "lower", "hair") else 0.02
        if person.textured[k] and kind in ("upper", "lower", "shoes"):
            row[KEEP] = 1.0 if rng.random() < _TEXTURE_KEPT else rng.uniform(0, 0.5)
        if kind in ("upper", "lower"):
            _pattern(rng, row, kind, chest)
        if kind == "upper":
            for number, side in enumerate((-1, 1)):
                if rng.random() < _PRINT_SHARE[side]:
                    _print(rng, row[PRINTS + number * PRINT_WIDTH :], side, chest)
    return rows


def has_print(rows: Array, side: int) -> bool:
    """Whether the upper garment of `random_paint` has a print in front (-1) or on the back (1)."""
    prints = rows[KINDS.index("upper"), PRINTS:].reshape(-1, PRINT_WIDTH)
    return bool(((prints[:, 0] != NO_PRINT) & (prints[:, 1] == side)).any())


def _pattern(rng: np.random.Generator, row: Array, kind: Kind, chest: float) -> None:
    shares = np.array(_PATTERN_SHARES)
    if kind == "lower":
        shares[1:] *= 0.3
    row[PATTERN] = rng.choice(len(shares), p=shares / shares.sum())
    row[PATTERN_TINT : PATTERN_TINT + 3] = garment_colour(rng)
    row[FREQUENCY] = rng.uniform(4, 13)
    row[PHASE] = rng.uniform(0, 1)
    row[DUTY] = rng.uniform(0.25, 0.6)
    if row[PATTERN] in (BLOCK, GRADIENT):
        row[PHASE] = chest - rng.uniform(0.1, 0.4) if kind == "upper" else chest - rng.uniform(0.7, 1.1)


def _print(rng: np.random.Generator, row: Array, side: int, chest: float) -> None:
    size = rng.uniform(0.05, 0.13)
    row[:5] = rng.integers(DISC, LETTERS + 1), side, rng.uniform(-0.04, 0.04), chest - rng.uniform(0.1, 0.25), size
    row[5:8] = garment_colour(rng)


def _tint(rng: np.random.Generator, kind: Kind, hair: Array) -> Array:
    if kind == "skin":
        return _skin_colour(rng)
    if kind == "eyes":
        return np.array([0.85, 0.84, 0.82])
    if kind in ("hair", "brows"):
        return hair if kind == "hair" else hair * 0.8
    return garment_colour(rng, dark=0.5 if kind == "shoes" else 0.15)


def garment_colour(rng: np.random.Generator, dark: float = 0.15) -> Array:
    """An sRGB colour [3] in [0,1]: greys and darks as often as people wear them, every hue alike otherwise."""
    draw = rng.random()
    if draw < 0.3:
        grey = rng.uniform(0.04, 0.2) if rng.random() < dark + 0.25 else rng.uniform(0.2, 0.97)
        return np.clip(np.full(3, grey) + rng.normal(0, 0.015, 3), 0, 1)
    if draw < 0.42:  # denim and navy
        return np.array(colorsys.hsv_to_rgb(rng.uniform(0.56, 0.64), rng.uniform(0.25, 0.75), rng.uniform(0.15, 0.65)))
    if draw < 0.52:  # khaki, brown, beige
        return np.array(colorsys.hsv_to_rgb(rng.uniform(0.05, 0.14), rng.uniform(0.2, 0.6), rng.uniform(0.2, 0.85)))
    saturation = rng.uniform(0.25, 1.0)
    return np.array(colorsys.hsv_to_rgb(rng.uniform(0, 1), saturation, rng.uniform(0.25, 1.0)))


def _skin_colour(rng: np.random.Generator) -> Array:
    """Along the line from light to dark skin, with a little of its own."""
    light, middle, deep = np.array([0.94, 0.78, 0.69]), np.array([0.76, 0.56, 0.44]), np.array([0.33, 0.21, 0.15])
    share = rng.uniform(0, 2)
    base = light + (middle - light) * share if share < 1 else middle + (deep - middle) * (share - 1)
    return np.clip(base * rng.uniform(0.93, 1.05, 3), 0, 1)


def _hair_colour(rng: np.random.Generator) -> Array:
    names = np.array([[0.06, 0.05, 0.05], [0.2, 0.12, 0.08], [0.38, 0.24, 0.14], [0.75, 0.6, 0.38], [0.5, 0.2, 0.1]])
    if rng.random() < 0.1:
        return np.full(3, rng.uniform(0.4, 0.85))
    if rng.random() < 0.04:
        return garment_colour(rng)
    return np.clip(names[rng.choice(5, p=[0.32, 0.3, 0.2, 0.12, 0.06])] * rng.uniform(0.8, 1.25, 3), 0, 1)
