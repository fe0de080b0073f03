"""Captions of people: garment and hair colours in a few words."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

NEUTRAL: Final = "a person"
COLOURS: Final[dict[str, tuple[float, float, float]]] = {
    "black": (0.08, 0.08, 0.08),
    "grey": (0.5, 0.5, 0.5),
    "white": (0.93, 0.93, 0.93),
    "red": (0.8, 0.12, 0.12),
    "orange": (0.9, 0.5, 0.12),
    "yellow": (0.9, 0.85, 0.2),
    "green": (0.2, 0.6, 0.2),
    "cyan": (0.2, 0.75, 0.75),
    "blue": (0.15, 0.25, 0.8),
    "navy": (0.1, 0.13, 0.33),
    "purple": (0.5, 0.2, 0.65),
    "pink": (0.93, 0.55, 0.7),
    "brown": (0.4, 0.24, 0.14),
    "beige": (0.82, 0.72, 0.56),
}
WEARABLES: Final = {"upper": "top", "lower": "trousers", "shoes": "shoes", "hair": "hair"}


def colour_name(rgb: Array) -> str:
    """The nearest of `COLOURS` to an sRGB colour [3] in [0,1]."""
    table = np.array(list(COLOURS.values()))
    return list(COLOURS)[int(((table - np.asarray(rgb)) ** 2).sum(1).argmin())]


def caption(colours: dict[str, Array]) -> str:
    """Like "a person, red top, blue trousers, black shoes, brown hair".

    Args:
        colours: mean sRGB colour [3] of each of `WEARABLES` that can be seen.
    """
    parts = [f"{colour_name(colours[kind])} {noun}" for kind, noun in WEARABLES.items() if kind in colours]
    return ", ".join([NEUTRAL, *parts])
