"""Everybody in a clip: found in each frame, linked into people, and shown on one sheet to choose from."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ahoy_core.perceive.appearance import appearance
from ahoy_core.perceive.crop import Roi, sample
from ahoy_core.perceive.detection import NMS_IOU, Detection, box_iou, detect, merge
from ahoy_core.perceive.networks import Networks
from ahoy_core.perceive.tracking import Track, apart, link

TILES_EVERY = 4  # frames: in between, people found on a tile are followed by the landmark network
TILED_FROM = 1.3  # of the long over the short side: wider pictures are also searched in squares
SAME_PLACE = 0.12  # of a crop, between the centres of two crops of one person
SAME_SIZE = 1.3  # and the larger of the two over the smaller
WORTH = 0.2  # of the most prominent person's prominence: others below are passers-by
TILE = 256  # pixels of a picture on the sheet


def find_people(
    networks: Networks, frames: NDArray[np.uint8], shot: NDArray[np.integer], tick: Callable[[str], None] | None = None
) -> list[Track]:
    """Detect and link everybody, most prominent first.

    Args:
        networks: the loaded networks.
        frames: [T,H,W,3] sRGB.
        shot: [T].
        tick: called after each frame.
    """
    detections, looks = [], []
    for t, frame in enumerate(frames):
        found = detect(networks, frame)
        if t % TILES_EVERY == 0:
            found = merge(found + [d for d in _on_tiles(networks, frame) if not _seen_already(d, found)])
        detections.append(found)
        looks.append([appearance(frame, d) for d in found])
        if tick:
            tick("finding people")
    return link(detections, shot, looks)


def _on_tiles(networks: Networks, frame: NDArray[np.uint8]) -> list[Detection]:
    """People in two overlapping squares of a wide or tall frame: there they are larger."""
    height, width = frame.shape[:2]
    side = min(height, width)
    if max(height, width) < TILED_FROM * side:
        return []
    found = []
    for corner in (0, max(height, width) - side):
        x, y = (corner, 0) if width > height else (0, corner)
        shift = np.array([x, y], np.float64)
        for d in detect(networks, np.ascontiguousarray(frame[y : y + side, x : x + side])):
            found.append(Detection(d.box + np.tile(shift, 2), d.keypoints + shift, d.score))
    return found


def _seen_already(on_tile: Detection, found: Sequence[Detection]) -> bool:
    """Whether the whole frame showed the same person with a head of another size, which `merge` would not join."""
    return any(
        box_iou(on_tile.box, other.box) <= NMS_IOU
        and apart(on_tile.roi, other.roi) < SAME_PLACE
        and abs(float(np.log(on_tile.roi.size / other.roi.size))) < float(np.log(SAME_SIZE))
        for other in found
    )


@dataclass(frozen=True)
class Subject:
    """One person to choose.

    Attributes:
        number: what `--subject` takes.
        frames: how many frames they were detected in.
        first: the first of these.
        last: the last.
        shots: numbers of the shots they appear in.
        size: median side of their crop, pixels.
        worth: prominence as a share of the most prominent person's.
    """

    number: int
    frames: int
    first: int
    last: int
    shots: tuple[int, ...]
    size: float
    worth: float


def subjects(people: Sequence[Track], shot: NDArray[np.integer]) -> list[Subject]:
    """Describe people, most prominent first."""
    return [
        Subject(
            number=k,
            frames=len(person.rois),
            first=min(person.rois),
            last=person.last,
            shots=tuple(sorted({int(shot[t]) for t in person.rois})),
            size=float(np.median([roi.size for roi in person.rois.values()])),
            worth=person.prominence / people[0].prominence,
        )
        for k, person in enumerate(people)
    ]


def worthwhile(people: Sequence[Track]) -> list[int]:
    """Numbers of the people who are more than passers-by, each worth an avatar."""
    return [k for k, person in enumerate(people) if person.prominence >= WORTH * people[0].prominence]


def subject_sheet(frames: NDArray[np.uint8], people: Sequence[Track], across: int = 4) -> NDArray[np.uint8]:
    """A row of pictures for each person, [rows*TILE, across*TILE, 3] uint8, their number in the corner."""
    rows = []
    for number, person in enumerate(people):
        known = sorted(person.rois)
        chosen = [known[i] for i in np.linspace(0, len(known) - 1, across).round().astype(int)]
        tiles = [np.round(255 * sample(frames[t], _upright(person.rois[t]), TILE)).astype(np.uint8) for t in chosen]
        row = np.ascontiguousarray(np.concatenate(tiles, axis=1))
        for colour, thick in (((0, 0, 0), 6), ((255, 255, 255), 2)):
            cv2.putText(row, str(number), (10, 44), cv2.FONT_HERSHEY_SIMPLEX, 1.4, colour, thick, cv2.LINE_AA)
        rows.append(row)
    return np.concatenate(rows) if rows else np.zeros((TILE, across * TILE, 3), np.uint8)


def _upright(roi: Roi) -> Roi:
    return Roi(roi.cx, roi.cy, roi.size, 0.0)
