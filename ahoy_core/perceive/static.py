"""What a still camera gives away: a pixel that looks as before can't have turned from furniture into a person.

The networks' masks spill over furniture in front of a person, here in one frame, there in another, while those pixels
never change. So wherever a pixel shows its usual colour, its mask is held at or below a low quantile of the values it
got when it looked like that. Where the mask always spills over the same edge, the furniture itself tells: a patch that
never changes, has no edge inside and lies mostly outside of all masks, or reaches well beyond them, is no person
anywhere. People's outlines move, so such a patch ends at them. With a moving camera few pixels keep a usual colour,
and nothing happens.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

MIN_FRAMES = 8  # fewer tell nothing about what is usual
MAX_SAMPLES = 48  # frames that the statistics are taken from
SAME_COLOUR = 4.0  # of 255, after smoothing: what noise and compression leave
SMOOTHING = 1.5  # pixels
QUANTILE = 0.1
STILL = 0.95  # share of the frames in which scenery looks as usual: people pass before it
EDGE = 10.0  # of 255 between neighbouring pixels: a patch ends at a larger step of the usual picture
OUTSIDE = 64  # of 255: masks held below it hold no person
MOVED = 0.5  # largest share of the person, such patches apart, that may look as usual all the time
MOSTLY = 0.5  # share of a patch that has to be outside
SOME, BEYOND = 0.15, 6.0  # ... or so much of it, where it reaches so many pixels further: a screen before a belly
RIM = 3  # pixels: as far out a patch may reach beyond where it was found
ALIKE = 20.0  # of 255, between a patch and its rim


def hold_static(frames: NDArray[np.uint8], masks: NDArray[np.uint8], shots: NDArray[np.integer]) -> NDArray[np.uint8]:
    """Lower masks where a pixel looks as usual but was not always taken for the person.

    Args:
        frames: [T,H,W,3] sRGB.
        masks: [T,H,W], 0 to 255.
        shots: [T]; each shot is judged on its own.

    Returns:
        [T,H,W], nowhere above `masks`. Shots of fewer than 8 frames are returned as they are.
    """
    held = masks.copy()
    for shot in np.unique(shots):
        inside = np.flatnonzero(shots == shot)
        if len(inside) < MIN_FRAMES:
            continue
        samples = inside[np.unique(np.linspace(0, len(inside) - 1, MAX_SAMPLES).round().astype(int))]
        usual = np.median(frames[samples], axis=0).astype(np.float32)
        same = np.stack([_looks_usual(frame, usual) for frame in frames[samples]])
        ceiling = _ceiling(same, masks[samples])
        found = scenery(usual, same.mean(axis=0) >= STILL, ceiling < OUTSIDE)
        ceiling[found] = 0
        rim = _rim(usual, found)
        for t in inside:
            usually = _looks_usual(frames[t], usual)
            held[t][usually] = np.minimum(masks[t], ceiling)[usually]
            # Smoothing mixes what moves into the last pixels of what does not: there each pixel is judged alone.
            held[t][rim & (np.abs(frames[t] - usual).max(axis=-1) < 2 * SAME_COLOUR)] = 0
    return held


def scenery(usual: NDArray[np.float32], still: NDArray[np.bool_], outside: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels of patches that never change and lie mostly outside of the person.

    Args:
        usual: [H,W,3] what each pixel usually looks like, 0 to 255.
        still: [H,W] where that hardly changes.
        outside: [H,W] where they are not taken for the person.

    Returns:
        [H,W]; nothing where the person hardly moves, as their outline would not stop a patch.
    """
    patch = _patches(usual, still)
    count, away = int(patch.max()) + 1, still & outside
    size, outer = (np.bincount(patch[part], minlength=count) for part in (still, away))
    reach = np.zeros(count, np.float32)
    np.maximum.at(reach, patch[away], cv2.distanceTransform(outside.astype(np.uint8), cv2.DIST_L2, 3)[away])
    found = still & ((outer >= MOSTLY * size) | ((outer >= SOME * size) & (reach > BEYOND)))[patch]
    person = still[~outside & ~found]
    return found if len(person) and person.mean() <= MOVED else np.zeros_like(found)


def _patches(usual: NDArray[np.float32], still: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Numbers [H,W] of patches: neighbouring pixels that never change and differ by less than an edge.

    From pixel to pixel, with no smoothing: the rim of a shelf is a few pixels wide, and a derivative of a smoothed
    picture sees nothing there but edges. The usual picture is a median over time and has little noise.
    """
    height, width = still.shape
    number = np.arange(height * width, dtype=np.int32).reshape(height, width)
    first, second = [], []
    for here, there in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        linked = still[here] & still[there] & (np.abs(usual[here] - usual[there]).max(axis=-1) < EDGE)
        first.append(number[here][linked])
        second.append(number[there][linked])
    links = np.concatenate(first), np.concatenate(second)
    graph = coo_array((np.ones(len(links[0]), dtype=bool), links), shape=(number.size, number.size))
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int32).reshape(height, width)


def _rim(usual: NDArray[np.float32], found: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels [H,W] round patches that usually have a patch's colour."""
    weight = cv2.blur(found.astype(np.float32), (2 * RIM + 1, 2 * RIM + 1))
    color = cv2.blur(usual * found[..., None], (2 * RIM + 1, 2 * RIM + 1)) / np.maximum(weight, 1e-6)[..., None]
    return np.asarray(~found & (weight > 1e-6) & (np.abs(usual - color).max(axis=-1) < ALIKE))


def _looks_usual(frame: NDArray[np.uint8], usual: NDArray[np.float32]) -> NDArray[np.bool_]:
    difference = cv2.GaussianBlur(frame.astype(np.float32) - usual, (0, 0), SMOOTHING)
    return np.asarray(np.abs(difference).max(axis=-1) < SAME_COLOUR)


def _ceiling(same: NDArray[np.bool_], masks: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Low quantile [H,W] of the masks over the frames in which the pixel looks as usual; 255 where it rarely does."""
    # Frames that look different sort to the end, so the quantile is a row of the sorted stack.
    ordered = np.sort(np.where(same, masks, np.uint8(255)), axis=0)
    count = same.sum(axis=0)
    row = np.floor(QUANTILE * np.maximum(count - 1, 0)).astype(np.int64)
    ceiling = np.take_along_axis(ordered, row[None], axis=0)[0]
    return np.where(count >= MIN_FRAMES // 2, ceiling, np.uint8(255)).astype(np.uint8)
