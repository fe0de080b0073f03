"""Who is who: detections of all frames linked into tracks, and the choice of the subject among them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ahoy_core.perceive.crop import Roi
from ahoy_core.perceive.detection import Detection

MAX_STEP = 0.5  # a person moves by at most this share of their crop from one detection to the next
MAX_SCALE = 1.8  # and changes size by at most this factor
MAX_GAP = 30  # frames without a detection after which a track ends


class NoPersonError(ValueError):
    """No person was found in any frame, or not the one who was asked for."""


@dataclass
class Track:
    """Crops of one person by frame number."""

    rois: dict[int, Roi] = field(default_factory=dict)

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


def link(detections: list[list[Detection]], shot: np.ndarray) -> list[Track]:
    """Link detections into tracks, greedily by distance, never across a cut; most prominent first.

    Args:
        detections: by frame.
        shot: [T] shot number of each frame.
    """
    tracks: list[Track] = []
    for frame, found in enumerate(detections):
        rois = [d.roi for d in found]
        alive = [t for t in tracks if shot[t.last] == shot[frame] and frame - t.last <= MAX_GAP]
        pairs = [(_distance(t.rois[t.last], roi), i, j) for i, t in enumerate(alive) for j, roi in enumerate(rois)]
        taken_tracks: set[int] = set()
        taken_rois: set[int] = set()
        for distance, i, j in sorted(pairs):
            if distance > 1.0 or i in taken_tracks or j in taken_rois:
                continue
            alive[i].rois[frame] = rois[j]
            taken_tracks.add(i)
            taken_rois.add(j)
        tracks += [Track({frame: roi}) for j, roi in enumerate(rois) if j not in taken_rois]
    return sorted(tracks, key=lambda t: -t.prominence)


def _distance(a: Roi, b: Roi) -> float:
    """0 for the same crop, above 1 for crops that can't be the same person one detection later."""
    step = float(np.hypot(a.cx - b.cx, a.cy - b.cy)) / (MAX_STEP * max(a.size, b.size))
    scale = abs(float(np.log(a.size / b.size))) / float(np.log(MAX_SCALE))
    return max(step, scale)


def choose(tracks: list[Track], shot: np.ndarray, subject: int | None) -> Track:
    """Pick the subject: the most prominent track, or the K-th most prominent.

    A cut ends every track. The default subject goes on in other shots with the most prominent person there, so that a
    clip with cuts of one person is used whole; a subject asked for by number stays within its shot, as nothing tells
    who is who after a cut.

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
    if subject is not None:
        if not 0 <= subject < len(tracks):
            raise NoPersonError(f"expected a subject from 0 to {len(tracks) - 1}, got {subject}")
        return tracks[subject]
    whole = Track()
    for number in np.unique(shot):
        inside = [t for t in tracks if shot[t.last] == number]
        if inside:
            whole.rois.update(inside[0].rois)
    return whole
