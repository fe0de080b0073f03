"""Which filling to believe, by evidence (DESIGN "Self-check"): hide what was observed, fill it, compare.

One score for every filling, the simple ones and a generative prior alike: the winner on a video is used for it, and its
error there is the confidence that can be reported for what the video never shows.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ahoy_core.texture.atlas import ObservedAtlas
from ahoy_core.texture.fill import FilledAtlas
from ahoy_core.texture.parts import PART_NAMES
from ahoy_core.texture.rays import BoolArray, FloatArray, IntArray
from ahoy_core.texture.surface import Surface
from ahoy_core.texture.texels import TexelMap


class Completion(Protocol):
    """What a filling does: an atlas with holes -> a complete one; what was seen stays as it was seen."""

    def __call__(
        self, observed: ObservedAtlas, surface: Surface, texels: TexelMap, vertices: FloatArray
    ) -> FilledAtlas:
        """See `ahoy_core.texture.fill.fill_atlas`."""
        ...


@dataclass(frozen=True)
class FillScore:
    """Mean absolute error, of 255, over the hidden texels, and by part (`PART_NAMES`) where any was hidden."""

    l1: float
    by_part: Mapping[str, float]


def score_fillings(
    observed: ObservedAtlas,
    surface: Surface,
    texels: TexelMap,
    vertices: FloatArray,
    hidden: BoolArray,
    fillings: Mapping[str, Completion],
) -> dict[str, FillScore]:
    """Hide observed texels, let the fillings compete on them.

    Args:
        observed: what was seen.
        surface: the body's triangles.
        texels: the atlas's N texels on them.
        vertices: [V,3] canonical pose, metres.
        hidden: [N] bool, texels to hide; those that were never observed don't count.
        fillings: by name.

    Raises:
        ValueError: when no observed texel would be hidden.
    """
    hidden = hidden & (observed.coverage.ravel()[texels.flat] > 0)
    if not hidden.any():
        raise ValueError("expected observed texels among those to hide, got none; hide another region")
    truth = observed.rgb.reshape(-1, 3)[texels.flat].astype(np.float64)
    without = _hide(observed, texels.flat[hidden])
    scores = {}
    for name, filling in fillings.items():
        filled = filling(without, surface, texels, vertices)
        error = np.abs(filled.rgb.reshape(-1, 3)[texels.flat] - truth)[hidden].mean(axis=1)
        part = filled.part[hidden]
        by_part = {PART_NAMES[k]: float(error[part == k].mean()) for k in np.unique(part)}
        scores[name] = FillScore(float(error.mean()), by_part)
    return scores


def _hide(observed: ObservedAtlas, flat: IntArray) -> ObservedAtlas:
    rgb, coverage, source = observed.rgb.copy(), observed.coverage.copy(), observed.source_frame.copy()
    rgb.reshape(-1, 3)[flat], coverage.reshape(-1)[flat], source.reshape(-1)[flat] = 0, 0, -1
    return ObservedAtlas(rgb, coverage, source)


def side_of(points: FloatArray, vertices: FloatArray, left: bool) -> BoolArray:
    """[N] bool: points [N,3] on one side of the canonical body, whose other side symmetry could copy."""
    middle = (vertices[:, 0].min() + vertices[:, 0].max()) / 2
    there: BoolArray = (points[:, 0] > middle) == left
    return there


def patches(points: FloatArray, vertices: FloatArray, count: int, radius: float, rng: np.random.Generator) -> BoolArray:
    """[N] bool: points [N,3] in some balls on the body and in their mirror images, so that symmetry knows nothing.

    Args:
        points: texels on the canonical body, metres.
        vertices: [V,3] canonical pose, metres.
        count: balls.
        radius: metres.
        rng: where the balls are.
    """
    middle = (vertices[:, 0].min() + vertices[:, 0].max()) / 2
    folded = np.stack([np.abs(points[:, 0] - middle), points[:, 1], points[:, 2]], axis=1)
    centres = folded[rng.choice(len(points), count, replace=False)]
    inside: BoolArray = (np.linalg.norm(folded[:, None] - centres[None], axis=2) < radius).any(axis=1)
    return inside
