"""Parts of a dressed person, by region and by garment: no fill takes colour from one part to another.

Head, hands, feet, legs, and trunk with arms are parts by the body's regions. Where trousers begin and sleeves end the
body does not know, so the border is looked for in the colours: along the trunk and along the arms, the cut that best
separates what was seen. Where both sides were seen and no cut separates them (a dress, long sleeves), there is no
border; where one side of the waist was not seen, nothing says that the shirt goes on, and the region's border holds.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ahoy_core.texture.rays import BoolArray, FloatArray, IntArray
from ahoy_core.texture.surface import ARM, LEG, Surface

TRUNK_PART, LEG_PART, HEAD_PART, HAND_PART, FOOT_PART, FOREARM_PART = range(6)
PART_NAMES = ("trunk", "legs", "head", "hands", "feet", "lower arms")

# Waists lie within this share of the body's height of where the legs begin; trousers end this high above the sole.
WAIST_BAND = 0.1
HEM_BAND = 0.22
# Seen heights that are further apart than this share of the body's height have something hidden between them.
HIDDEN_GAP = 0.03
# A cut has to leave this many seen vertices on either side.
LEAST_SIDE = 12
# Lightness counts this much beside hue and saturation (CIE Lab): folds and shadows change it, garments all three.
LIGHTNESS_WEIGHT = 0.3
# Two garments are this far apart in such colours; one garment's upper and lower half in uneven light are at most 5.
LEAST_CONTRAST = 8.0
# ... and the cut explains at least this share of the colours' variance: prints and stripes do not.
LEAST_EXPLAINED = 0.5


@dataclass(frozen=True)
class Parts:
    """Part of each vertex [V] (index into `PART_NAMES`), and which garment borders the colours showed."""

    of_vertex: IntArray
    found: tuple[str, ...]


def find_parts(surface: Surface, vertices: FloatArray, colours: FloatArray, seen: BoolArray) -> Parts:
    """Divide the body's vertices into parts.

    Args:
        surface: the body's triangles.
        vertices: [V,3] canonical pose, metres.
        colours: [V,3] in 0..255, of the seen vertices.
        seen: [V] bool.
    """
    part = np.full(len(vertices), TRUNK_PART)
    part[surface.limb == LEG] = LEG_PART
    found = []
    height = vertices[:, 2] - vertices[:, 2].min()
    tall = float(height.max())
    dressed = ~surface.head & ~surface.hands & ~surface.feet
    legs = surface.limb == LEG
    if legs.any():
        body = dressed & (surface.limb != ARM)
        top = float(np.quantile(height[legs & dressed], 0.95)) if (legs & dressed).any() else 0.0
        band = body & (np.abs(height - top) < WAIST_BAND * tall)
        waist = best_cut(height[band & seen], colours[band & seen])
        if waist is None:
            waist = _hidden_waist(height, colours, body & seen & (height < top + WAIST_BAND * tall), top)
        if waist is not None:
            part[body] = np.where(height[body] < waist, LEG_PART, TRUNK_PART)
            found.append("waist")
        elif min((band & seen & legs).sum(), (band & seen & ~legs).sum()) >= LEAST_SIDE:
            part[body] = TRUNK_PART
    arms = dressed & (surface.limb == ARM)
    along = _along_arms(vertices)
    sleeve = best_cut(along[arms & seen], colours[arms & seen])
    if sleeve is not None:
        part[arms & (along > sleeve)] = FOREARM_PART
        found.append("sleeves")
    shoes = legs & (height < HEM_BAND * tall)
    hem = best_cut(height[shoes & seen], colours[shoes & seen])
    part[surface.feet] = FOOT_PART
    if hem is not None:
        part[shoes] = np.where(height[shoes] < hem, FOOT_PART, part[shoes])
        part[surface.feet & (height >= hem)] = LEG_PART
        found.append("hems")
    part[surface.head], part[surface.hands] = HEAD_PART, HAND_PART
    return Parts(part, tuple(found))


def _hidden_waist(height: FloatArray, colours: FloatArray, seen: BoolArray, top: float) -> float | None:
    """Where a garment begins of which only something far below was seen: behind a desk, the shirt's end too is hidden.

    The colours tell between which two seen heights the border lies, not where; the height at which legs begin decides
    as far as that goes.
    """
    cut = best_cut(height[seen], colours[seen])
    if cut is None:
        return None
    low, high = height[seen & (height < cut)].max(), height[seen & (height >= cut)].min()
    return float(np.clip(top, low, high)) if high - low > HIDDEN_GAP * height.max() else cut


def _along_arms(vertices: FloatArray) -> FloatArray:
    """Distance [V] down arms that point outwards and down at 45 degrees, as the canonical pose has them."""
    middle = (vertices[:, 0].min() + vertices[:, 0].max()) / 2
    outward: FloatArray = (np.abs(vertices[:, 0] - middle) - vertices[:, 2]) / np.sqrt(2)
    return outward


def best_cut(along: FloatArray, colours: FloatArray) -> float | None:
    """Where two garments meet, or None where the colours show no such place.

    Args:
        along: [N] positions along a limb, metres.
        colours: [N,3] in 0..255 of what was seen there.
    """
    if len(along) < 2 * LEAST_SIDE:
        return None
    order = np.argsort(along, kind="stable")
    along, colours = along[order], little_lightness(colours[order])
    total = float(np.square(colours - colours.mean(axis=0)).sum())
    if total <= 0:
        return None
    sums, count = np.cumsum(colours, axis=0), np.arange(1, len(along) + 1)
    cuts = np.arange(LEAST_SIDE, len(along) - LEAST_SIDE + 1)
    below, above = sums[cuts - 1] / count[cuts - 1, None], (sums[-1] - sums[cuts - 1]) / (len(along) - cuts)[:, None]
    between = cuts * (len(along) - cuts) / len(along) * np.square(below - above).sum(axis=1)
    best = int(between.argmax())
    contrast = float(np.linalg.norm(below[best] - above[best]))
    if contrast < LEAST_CONTRAST or between[best] < LEAST_EXPLAINED * total:
        return None
    return float(along[cuts[best] - 1 : cuts[best] + 1].mean())


def little_lightness(colours: FloatArray) -> FloatArray:
    """[N,3] CIE Lab colours of sRGB ones in 0..255, lightness counted less."""
    lab = cv2.cvtColor((colours[None] / 255).astype(np.float32), cv2.COLOR_RGB2Lab)[0].astype(np.float64)
    weighted: FloatArray = lab * (LIGHTNESS_WEIGHT, 1.0, 1.0)
    return weighted
