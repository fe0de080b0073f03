"""The head's share of the visible person: the body's head region, with the hair that the body lacks."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ahoy_core.perceive.masks import VISIBLE
from ahoy_core.texture.rays import Caster, hit_map

HAIR_REACH = 0.6  # of the head's height: visible pixels farther from the head than this are not its hair


def head_mask(
    points: NDArray[np.floating],
    faces: NDArray[np.integer],
    head: NDArray[np.bool_],
    K: NDArray[Any],
    visible: NDArray[np.uint8],
) -> NDArray[np.uint8]:
    """The head's alpha.

    A visible pixel on the fitted body belongs to the head if the body's nearest surface there is the head's; one beside
    the body, to whichever is nearer in the picture. So an arm before the face is left out, and hair is kept.

    Args:
        points: [V,3] posed vertices, camera axes, metres.
        faces: [F,3].
        head: [F] triangles of the head.
        K: [3,3] pixels.
        visible: [H,W] uint8 alpha of the visible person.

    Returns:
        [H,W] uint8, nowhere above `visible`; zeros where no head is in view.
    """
    height, width = visible.shape
    hits = hit_map(Caster(points, faces), np.asarray(K, np.float64), width, height)
    body = hits.face >= 0
    ours = body & head[np.maximum(hits.face, 0)]
    if not ours.any():
        return np.zeros_like(visible)
    to_head, to_rest = (
        cv2.distanceTransform((~part).astype(np.uint8), cv2.DIST_L2, 5) for part in (ours, body & ~ours)
    )
    rows = np.flatnonzero(ours.any(1))
    reach = HAIR_REACH * (rows[-1] - rows[0] + 1)
    beside = ~body & (to_head <= to_rest) & (to_head < reach)
    return np.where(ours | beside, visible, np.uint8(0)) if (visible > VISIBLE).any() else np.zeros_like(visible)
