"""Landmarks of one person in every frame: detect, choose the subject, then follow them from frame to frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ahoy_core.perceive.corrector import MIRROR as MIRROR_BODY
from ahoy_core.perceive.crop import Roi, paste, roi_from_points, sample
from ahoy_core.perceive.networks import LANDMARKER_SIZE, N_LANDMARKS, Networks, RawLandmarks, sigmoid
from ahoy_core.perceive.people import find_people
from ahoy_core.perceive.tracking import Track, belongs_to_another, choose

Progress = Callable[[int, int, str], None]

MIN_SCORE = 0.5  # of the landmark network, for a person to be in the crop
MAX_DRIFT = 0.35  # share of the crop by which a followed crop may differ from the detection before that one is believed
HIPS, CIRCLE = 33, 34  # raw landmarks that steer the next frame's crop
HEATMAP_WINDOW = 3  # cells to each side that refine a landmark
MIN_HEAT = 0.5  # below it the heatmap says nothing
PASSES = 4
# The network's 39 raw landmarks with left and right exchanged.
MIRROR = np.array([*MIRROR_BODY, *range(N_LANDMARKS, 39)])


@dataclass(frozen=True)
class LandmarkTrack:
    """One person's landmarks; rows of frames in which the person was not found are zero.

    Attributes:
        landmarks: [T,33,3] x, y in image pixels, z in the same unit relative to the hips, negative towards the camera.
        world: [T,33,3] metres, hips at the origin, x right, y down, z away from the camera.
        visibility: [T,33] in [0,1]: the landmark is neither hidden nor out of the picture.
        masks: [T,256,256] uint8, the person in the crop.
        rois: the crop of each frame, None where not found.
        score: [T] in [0,1].
        found: [T].
        people: how many tracks there were to choose from.
    """

    landmarks: NDArray[np.float32]
    world: NDArray[np.float32]
    visibility: NDArray[np.float32]
    masks: NDArray[np.uint8]
    rois: tuple[Roi | None, ...]
    score: NDArray[np.float32]
    found: NDArray[np.bool_]
    people: int

    def mask(self, frame: int, height: int, width: int) -> NDArray[np.float32]:
        """Return the person's mask in the image, [height,width] in [0,1]."""
        roi = self.rois[frame]
        if roi is None:
            return np.zeros((height, width), np.float32)
        return paste(self.masks[frame].astype(np.float32) / 255.0, roi, height, width)


@dataclass(frozen=True)
class Reading:
    """The network's answer for one crop, in the image: points [39,3], world [39,3], visibility [39], mask, score."""

    points: NDArray[np.float64]
    world: NDArray[np.float64]
    visibility: NDArray[np.float64]
    mask: NDArray[np.float32]
    score: float
    roi: Roi

    def next_roi(self) -> Roi:
        """The crop for the next frame, as the network steers it."""
        return roi_from_points(self.points[HIPS, :2], self.points[CIRCLE, :2])


def run_landmarks(
    networks: Networks,
    frames: NDArray[np.uint8],
    shot: NDArray[np.integer] | None = None,
    *,
    subject: int | None = None,
    passes: Literal[1, 2, 3, 4] = 2,
    progress: Progress | None = None,
) -> LandmarkTrack:
    """Find and follow one person.

    Args:
        networks: the loaded networks.
        frames: [T,H,W,3] sRGB.
        shot: [T] shot number of each frame; one shot unless given.
        subject: number of the person, 0 or None the most prominent.
        passes: 1 forward; 2 also mirrored; 3 forward, mirrored and backward in time; 4 also backward mirrored. Their
            mean is returned.
        progress: called with steps done and in total.

    Raises:
        ValueError: `frames` has another dtype or shape.
        NoPersonError: see `tracking.choose`.
    """
    if frames.dtype != np.uint8 or frames.ndim != 4 or frames.shape[3] != 3 or len(frames) == 0:
        raise ValueError(f"expected frames of uint8 [T,H,W,3] with T > 0, got {frames.dtype} {frames.shape}")
    cuts = np.zeros(len(frames), np.int32) if shot is None else np.asarray(shot)
    backward = passes >= 3
    total, done = len(frames) * (2 + backward), 0

    def tick(note: str) -> None:
        nonlocal done
        done += 1
        if progress:
            progress(done, total, note)

    tracks = find_people(networks, frames, cuts, tick)
    track = choose(tracks, cuts, subject)
    runs = [_follow(networks, frames, cuts, track, tracks, range(len(frames)), passes >= 2, tick)]
    if backward:
        order = range(len(frames) - 1, -1, -1)
        runs.append(_follow(networks, frames, cuts, track, tracks, order, passes == 4, tick))
    return _collect([_average([run[t] for run in runs]) for t in range(len(frames))], len(tracks))


def _follow(
    networks: Networks,
    frames: NDArray[np.uint8],
    shot: NDArray[np.integer],
    track: Track,
    tracks: list[Track],
    order: range,
    mirrored: bool,
    tick: Callable[[str], None],
) -> dict[int, list[Reading]]:
    """Read every frame in the given order, each crop placed by the frame before it or by the detector."""
    shots_with_subject = {int(shot[t]) for t in track.rois}
    readings: dict[int, list[Reading]] = {}
    roi: Roi | None = None
    previous = order[0]
    for t in order:
        tick("following the person")
        readings[t] = []
        roi = roi if shot[t] == shot[previous] else None
        previous = t
        if int(shot[t]) not in shots_with_subject:
            continue
        reading = _read_first(networks, frames[t], _candidates(roi, track, t), track, tracks, t)
        roi = reading.next_roi() if reading else None
        if reading:
            readings[t].append(reading)
            if mirrored:
                readings[t].append(read_crop(networks, frames[t], reading.roi, mirrored=True))
    return readings


def _candidates(followed: Roi | None, track: Track, t: int) -> list[Roi]:
    """Crops to try, best first: the followed one, unless this frame's detection is elsewhere."""
    detected = track.rois.get(t)
    if followed is None:
        return [detected or track.near(t)]
    if detected is None:
        return [followed, track.near(t)]
    drift = np.hypot(followed.cx - detected.cx, followed.cy - detected.cy) / detected.size
    return [followed, detected] if drift < MAX_DRIFT else [detected, followed]


def _read_first(
    networks: Networks, frame: NDArray[np.uint8], rois: list[Roi], track: Track, tracks: list[Track], t: int
) -> Reading | None:
    """The reading of the first crop that shows a person, and not another one."""
    for roi in rois:
        reading = read_crop(networks, frame, roi)
        if reading.score >= MIN_SCORE and not belongs_to_another(reading.next_roi(), track, tracks, t):
            return reading
    return None


def read_crop(networks: Networks, frame: NDArray[np.uint8], roi: Roi, mirrored: bool = False) -> Reading:
    """Run the network on one crop (seen in a mirror if asked) and return its answer in image coordinates."""
    crop = sample(frame, roi, LANDMARKER_SIZE)
    raw = networks.landmarks(crop[:, ::-1] if mirrored else crop)
    points = _refine(raw) / LANDMARKER_SIZE
    world, visibility, mask = raw.world.astype(np.float64), np.minimum(raw.visibility, raw.presence), raw.mask
    if mirrored:
        points, world, visibility, mask = points[MIRROR], world[MIRROR], visibility[MIRROR], mask[:, ::-1]
        points[:, 0] = 1.0 - points[:, 0]
        world[:, 0] = -world[:, 0]
    rotation = roi.matrix()[:, :2] / roi.size
    return Reading(
        points=np.concatenate([roi.to_image(points[:, :2]), points[:, 2:] * roi.size], axis=1),
        world=np.concatenate([world[:, :2] @ rotation.T, world[:, 2:]], axis=1),
        visibility=visibility.astype(np.float64),
        mask=mask,
        score=raw.score,
        roi=roi,
    )


def _refine(raw: RawLandmarks) -> NDArray[np.float64]:
    """Move each landmark to the heat round it (MediaPipe's heatmap refinement); returns [39,3] in crop pixels."""
    points = raw.points.astype(np.float64)
    cells = raw.heatmap.shape[0]
    scale = LANDMARKER_SIZE / cells
    for i, (x, y) in enumerate(points[:, :2] / scale):
        column, row = int(x), int(y)
        if not (0 <= column < cells and 0 <= row < cells):
            continue
        rows = slice(max(0, row - HEATMAP_WINDOW), row + HEATMAP_WINDOW + 1)
        columns = slice(max(0, column - HEATMAP_WINDOW), column + HEATMAP_WINDOW + 1)
        heat = sigmoid(raw.heatmap[rows, columns, i])
        if heat.max() < MIN_HEAT:
            continue
        ys, xs = np.mgrid[rows.start : rows.start + heat.shape[0], columns.start : columns.start + heat.shape[1]]
        points[i, 0] = (heat * xs).sum() / heat.sum() * scale
        points[i, 1] = (heat * ys).sum() / heat.sum() * scale
    return points


def _average(groups: list[list[Reading]]) -> Reading | None:
    """Average readings of one frame: landmarks by visibility, masks in the first one's crop."""
    readings = [reading for group in groups for reading in group if reading.score >= MIN_SCORE]
    if not readings:
        return None
    first = readings[0]
    weights = np.stack([r.visibility + 1e-3 for r in readings])
    weights = (weights / weights.sum(0))[..., None]
    masks = [r.mask if r.roi == first.roi else _recrop(r, first.roi) for r in readings]
    return replace(
        first,
        points=(weights * np.stack([r.points for r in readings])).sum(0),
        world=(weights * np.stack([r.world for r in readings])).sum(0),
        visibility=np.mean([r.visibility for r in readings], axis=0),
        mask=np.mean(masks, axis=0),
        score=float(np.mean([r.score for r in readings])),
    )


def _recrop(reading: Reading, roi: Roi) -> NDArray[np.float32]:
    """Resample a mask from its own crop into another one."""
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    a, b, c = reading.roi.to_crop(roi.to_image(corners)) * LANDMARKER_SIZE
    size = float(np.hypot(*(b - a)))
    angle = float(np.arctan2(b[1] - a[1], b[0] - a[0]))
    centre = (b + c) / 2
    mask = np.repeat((reading.mask * 255).astype(np.uint8)[..., None], 3, axis=2)
    return sample(mask, Roi(float(centre[0]), float(centre[1]), size, angle), LANDMARKER_SIZE)[..., 0]


def _collect(readings: list[Reading | None], people: int) -> LandmarkTrack:
    """Stack the readings of all frames."""
    n = len(readings)
    landmarks = np.zeros((n, N_LANDMARKS, 3), np.float32)
    world = np.zeros((n, N_LANDMARKS, 3), np.float32)
    visibility = np.zeros((n, N_LANDMARKS), np.float32)
    masks = np.zeros((n, LANDMARKER_SIZE, LANDMARKER_SIZE), np.uint8)
    score = np.zeros(n, np.float32)
    for t, reading in enumerate(readings):
        if reading is None:
            continue
        landmarks[t], world[t] = reading.points[:N_LANDMARKS], reading.world[:N_LANDMARKS]
        visibility[t], score[t] = reading.visibility[:N_LANDMARKS], reading.score
        masks[t] = np.round(np.clip(reading.mask, 0, 1) * 255)
    rois = tuple(reading.roi if reading else None for reading in readings)
    found = np.array([reading is not None for reading in readings])
    return LandmarkTrack(landmarks, world, visibility, masks, rois, score, found, people)
