"""Reading a video in: select frames, reduce them, note their times, find the cuts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ahoy_core.formats.errors import DamagedVideoError, EmptySelectionError
from ahoy_core.formats.video import Video, VideoProbe, decode, scan
from ahoy_core.formats.video_frames import Size, limited
from ahoy_core.ingest.config import IngestConfig
from ahoy_core.ingest.shots import THUMBNAIL, ShotDetector

Progress = Callable[[int, int], None]

_LARGE = 4096  # pixels; above it the reduction is worth a sentence of its own


@dataclass(frozen=True)
class Ingest:
    """Frames of a video, ready for the next stage.

    Attributes:
        frames: uint8 [T,H,W,3], sRGB, upright, square pixels.
        index: int64 [T], frame number in the source, increasing.
        pts: float64 [T], seconds from the first frame of the source, increasing.
        shot: int32 [T], shot number from 0, without gaps.
        probe: what the file is.
        notes: what was done to the video and what is wrong with it, one sentence each.
    """

    frames: np.ndarray = field(repr=False)
    index: np.ndarray = field(repr=False)
    pts: np.ndarray = field(repr=False)
    shot: np.ndarray = field(repr=False)
    probe: VideoProbe
    notes: tuple[str, ...]

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays of `frames.npz` in the stage's artifact."""
        return {"frames": self.frames, "index": self.index, "pts": self.pts, "shot": self.shot}

    def summary(self) -> dict[str, Any]:
        """The contents of `probe.json`: plain values only."""
        return {
            "probe": asdict(self.probe),
            "notes": list(self.notes),
            "frames": len(self.frames),
            "width": self.frames.shape[2],
            "height": self.frames.shape[1],
            "shots": int(self.shot.max()) + 1,
        }


def ingest(path: str | Path, config: IngestConfig | None = None, progress: Progress | None = None) -> Ingest:
    """Read a video in.

    Holds the kept frames at their reduced size, and never more than a few decoded pictures at full size.

    Args:
        path: local video file.
        config: which frames, and how large.
        progress: called with (frames decoded, frames to decode).

    Returns:
        Frames, times, shots and notes.

    Raises:
        VideoError: the video cannot be used; see `ahoy_core.formats.errors`.
    """
    config = config or IngestConfig()
    video = scan(path)
    inside, chosen = select(video.pts, config)
    if not len(chosen):
        raise EmptySelectionError(
            f"expected frames from {config.start_s} s to {config.end_s or 'the end'}, got none in {video.path.name!r}, "
            f"which lasts {video.probe.duration:.2f} s: choose another range"
        )
    notes: list[str] = []
    size = limited(Size(video.probe.width, video.probe.height), config.max_size)
    kept = _read(video, inside, chosen, size, config, notes.append, progress)
    head = [*_selection_notes(len(video.pts), len(inside), len(chosen), config), *_size_notes(video, size)]
    if len(kept.index) < len(chosen):
        notes.append(f"{len(chosen) - len(kept.index)} of {len(chosen)} chosen frames did not decode and are missing")
    return Ingest(*kept.arrays(), probe=video.probe, notes=(*video.probe.warnings, *head, *notes))


def select(pts: np.ndarray, config: IngestConfig) -> tuple[np.ndarray, np.ndarray]:
    """Choose frames by time range, stride and number.

    Args:
        pts: float64 [T], seconds, increasing.
        config: the choice.

    Returns:
        int64 numbers of the frames in the time range, and of those to keep among them.
    """
    end = np.inf if config.end_s is None else config.end_s
    inside = np.flatnonzero((pts >= config.start_s) & (pts < end)).astype(np.int64)
    chosen = inside[:: config.stride]
    if config.max_frames is not None and len(chosen) > config.max_frames:
        chosen = chosen[np.arange(config.max_frames) * len(chosen) // config.max_frames]
    return inside, chosen


@dataclass
class _Kept:
    frames: np.ndarray
    index: np.ndarray
    pts: np.ndarray
    shot: np.ndarray

    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        return self.frames, self.index, self.pts, self.shot


def _read(
    video: Video,
    inside: np.ndarray,
    chosen: np.ndarray,
    size: Size,
    config: IngestConfig,
    warn: Callable[[str], None],
    progress: Progress | None,
) -> _Kept:
    frames = np.empty((len(chosen), size.height, size.width, 3), np.uint8)
    wanted = set(chosen.tolist())
    detector = ShotDetector(config.shots)
    seen: list[int] = []
    kept: list[int] = []
    first, last = int(inside[0]), int(inside[-1])
    for frame in decode(video, warn):
        if frame.index > last:
            break
        if progress:
            progress(frame.index + 1, last + 1)
        if frame.index < first:
            continue
        # Frames that are not kept count for the cuts, too: the closer the pictures are in time, the clearer a cut.
        detector.add(frame.image(THUMBNAIL))
        seen.append(frame.index)
        if frame.index in wanted:
            frames[len(kept)] = frame.image(config.max_size)
            kept.append(frame.index)
    if not kept:
        raise DamagedVideoError(
            f"expected at least one of {len(chosen)} chosen frames to decode, got none in {video.path.name!r}: "
            "the file is damaged there; choose another range or copy it again"
        )
    index = np.array(kept, np.int64)
    shot = np.searchsorted([seen[cut] for cut in detector.cuts()], index, side="right")
    numbers = np.unique(shot, return_inverse=True)[1].astype(np.int32)
    return _Kept(frames[: len(kept)], index, video.pts[index], numbers)


def _selection_notes(total: int, inside: int, chosen: int, config: IngestConfig) -> list[str]:
    notes = []
    if inside < total:
        notes.append(f"{inside} of {total} frames lie in the chosen time range")
    if config.stride > 1:
        notes.append(f"every {config.stride}th frame is used")
    if chosen < -(-inside // config.stride):
        notes.append(f"thinned evenly to {chosen} frames (max_frames)")
    return notes


def _size_notes(video: Video, size: Size) -> list[str]:
    shown = Size(video.probe.width, video.probe.height)
    notes = []
    if size != shown:
        large = " (a very large video: reduced while decoding)" if max(shown) > _LARGE else ""
        notes.append(
            f"reduced from {shown.width}x{shown.height} to {size.width}x{size.height} with an area filter{large}"
        )
    if video.orientation.transpose or video.orientation.flip_x or video.orientation.flip_y:
        mirrored = " and mirrored" if video.probe.mirrored else ""
        notes.append(f"turned upright by {video.probe.rotation} degrees clockwise{mirrored}")
    if video.probe.variable_rate:
        notes.append("the frame rate varies: each frame keeps its own time")
    return notes
