"""Who is who: detections linked into tracks by motion and appearance, tracks of all shots into people."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from ahoy_core.perceive.appearance import unlikeness
from ahoy_core.perceive.crop import Roi
from ahoy_core.perceive.detection import Detection

MAX_STEP = 0.5  # a person is within this share of their crop of where their motion leads
MAX_SCALE = 1.8  # and changes size by at most this factor
MAX_GAP = 30  # frames without a detection after which a track ends
GAP_GROWTH = 0.03  # of the crop, that the place grows uncertain by in each frame without a detection
LOOKS = 1.2  # weight of appearance against place: two who cross are told apart by their clothes
STRANGER = 0.7  # unlikeness from which it is another person, wherever they are
SAME_PERSON = 0.52  # unlikeness up to which people of two shots are the same
SLIPPED = 0.2  # of a crop, from somebody's detection, up to which a reading may be theirs
TELLING = 0.05  # and by how much farther the subject's own detection has to be
MEMORY = 8  # last detections that give a track's velocity
FADE = 0.9  # share of the old appearance that is kept at each new detection
IMPOSSIBLE = 1e6


class NoPersonError(ValueError):
    """No person was found in any frame, or not the one who was asked for."""


@dataclass
class Track:
    """Crops of one person by frame number, and what they look like (empty where that was never measured)."""

    rois: dict[int, Roi] = field(default_factory=dict)
    looks: NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))

    @property
    def last(self) -> int:
        """The last frame with a detection."""
        return max(self.rois)

    @property
    def prominence(self) -> float:
        """Length times size: the sum of the crops' sides in pixels."""
        return float(sum(roi.size for roi in self.rois.values()))

    def near(self, frame: int) -> Roi:
        """Return the crop at a frame, interpolated between detections, held before the first and after the last."""
        known = sorted(self.rois)
        sides = np.array([(r.cx, r.cy, r.size, r.angle) for r in (self.rois[k] for k in known)])
        sides[:, 3] = np.unwrap(sides[:, 3])
        return Roi(*(float(np.interp(frame, known, column)) for column in sides.T))

    def expected(self, frame: int) -> tuple[float, float]:
        """Centre at a later frame if the recent motion goes on, slowing down over a gap."""
        known = sorted(self.rois)[-MEMORY:]
        end = self.rois[known[-1]]
        if len(known) < 3:
            return end.cx, end.cy
        places = np.array([(self.rois[k].cx, self.rois[k].cy) for k in known])
        velocity = np.polyfit(np.array(known, float), places, 1)[0]
        ahead = min(frame - known[-1], MEMORY)
        return end.cx + ahead * float(velocity[0]), end.cy + ahead * float(velocity[1])

    def add(self, frame: int, roi: Roi, looks: NDArray[np.float32] | None) -> None:
        """Append a detection."""
        self.rois[frame] = roi
        if looks is not None:
            mixed = looks if self.looks.size == 0 else FADE * self.looks + (1 - FADE) * looks
            self.looks = np.asarray(mixed / max(float(np.linalg.norm(mixed)), 1e-9), np.float32)


Looks = Sequence[Sequence[NDArray[np.float32]]]


def link(detections: list[list[Detection]], shot: np.ndarray, looks: Looks | None = None) -> list[Track]:
    """Link detections into people, most prominent first: in a shot by place and looks, across cuts by looks alone.

    Args:
        detections: by frame.
        shot: [T] shot number of each frame.
        looks: `appearance` of each detection; without it place alone decides, and every shot has people of its own.
    """
    finished: list[Track] = []
    alive: list[Track] = []
    for frame, found in enumerate(detections):
        ended = [t for t in alive if shot[t.last] != shot[frame] or frame - t.last > MAX_GAP]
        finished += ended
        alive = [t for t in alive if not any(t is e for e in ended)]
        seen = looks[frame] if looks is not None else [None] * len(found)
        rois = [d.roi for d in found]
        taken = set()
        for i, j in _match(alive, rois, seen, frame):
            alive[i].add(frame, rois[j], seen[j])
            taken.add(j)
        for j, roi in enumerate(rois):
            if j not in taken:
                alive.append(Track())
                alive[-1].add(frame, roi, seen[j])
    return _people(finished + alive, shot)


def _match(
    tracks: list[Track], rois: list[Roi], looks: Sequence[NDArray[np.float32] | None], frame: int
) -> list[tuple[int, int]]:
    """Pairs of tracks and detections with the least total distance."""
    if not tracks or not rois:
        return []
    cost = np.array([[_distance(t, roi, look, frame) for roi, look in zip(rois, looks, strict=True)] for t in tracks])
    rows, columns = linear_sum_assignment(cost)
    return [(int(i), int(j)) for i, j in zip(rows, columns, strict=True) if cost[i, j] < IMPOSSIBLE]


def _distance(track: Track, roi: Roi, looks: NDArray[np.float32] | None, frame: int) -> float:
    """From 0, the same place and look; `IMPOSSIBLE` for another person."""
    last, gap = track.rois[track.last], frame - track.last - 1
    x, y = track.expected(frame)
    reach = (MAX_STEP + GAP_GROWTH * gap) * max(last.size, roi.size)
    step = float(np.hypot(x - roi.cx, y - roi.cy)) / reach
    scale = abs(float(np.log(roi.size / last.size))) / float(np.log(MAX_SCALE))
    away = max(step, scale)
    if away > 1.0:
        return IMPOSSIBLE
    if looks is None or track.looks.size == 0:
        return away
    unlike = unlikeness(track.looks, looks)
    return away + LOOKS * unlike if unlike < STRANGER else IMPOSSIBLE


def _people(tracks: list[Track], shot: np.ndarray) -> list[Track]:
    """Join tracks that look the same and never show at once, the longest first; most prominent first."""
    people: list[Track] = []
    for track in sorted(tracks, key=lambda t: -t.prominence):
        fits = [(unlikeness(p.looks, track.looks), i) for i, p in enumerate(people) if _may_join(p, track, shot)]
        best = min(fits, default=(1.0, -1))
        if best[0] < SAME_PERSON:
            people[best[1]].rois.update(track.rois)
        else:
            people.append(track)
    return sorted(people, key=lambda t: -t.prominence)


def _may_join(person: Track, track: Track, shot: np.ndarray) -> bool:
    """Whether both have a look, and no shot holds frames of both that overlap in time."""
    if person.looks.size == 0 or track.looks.size == 0:
        return False
    for number in {int(shot[t]) for t in track.rois}:
        theirs = [t for t in person.rois if shot[t] == number]
        ours = [t for t in track.rois if shot[t] == number]
        if theirs and min(theirs) <= max(ours) and min(ours) <= max(theirs):
            return False
    return True


def choose(tracks: list[Track], shot: np.ndarray, subject: int | None) -> Track:
    """Pick the subject: the most prominent person, or the K-th most prominent.

    Args:
        tracks: most prominent first.
        shot: [T].
        subject: K from 0, or None for the most prominent.

    Raises:
        NoPersonError: there are no tracks, or fewer than K + 1.
    """
    if not tracks:
        raise NoPersonError(
            f"expected a person in at least one of {len(shot)} frames, got none; "
            "use a clip in which a person is larger or better lit"
        )
    if not 0 <= (subject or 0) < len(tracks):
        raise NoPersonError(
            f"expected a subject from 0 to {len(tracks) - 1}, got {subject}; "
            "`ahoy run VIDEO --list-subjects` shows them"
        )
    return tracks[subject or 0]


def belongs_to_another(roi: Roi, subject: Track, others: Sequence[Track], frame: int) -> bool:
    """Whether a crop has slipped onto somebody else: it lies on theirs, and not on the subject's where that was found.

    Who passes in front takes the landmark network's eye even in the subject's own crop.
    """
    own = subject.rois.get(frame)
    away = np.inf if own is None else apart(roi, own)
    near = [apart(roi, t.rois[frame]) for t in others if t is not subject and frame in t.rois]
    return any(distance < SLIPPED and distance + TELLING < away for distance in near)


def apart(roi: Roi, of: Roi) -> float:
    """Distance of two crops' centres, in sides of the second."""
    return float(np.hypot(roi.cx - of.cx, roi.cy - of.cy)) / of.size
