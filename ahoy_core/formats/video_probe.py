"""What is in a video file: its format and the time of every frame."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.container import InputContainer
from av.video.stream import VideoStream

from ahoy_core.formats.errors import DamagedVideoError, NoFramesError
from ahoy_core.formats.video_frames import Orientation, has_alpha, orientation_of, square_pixel_size
from ahoy_core.formats.video_open import open_video, video_stream
from ahoy_core.formats.video_packets import Timeline, stored_frames, timeline_of

_HDR_TRANSFERS = {16: "PQ", 18: "HLG"}
_ALPHA_TAG = "alpha_mode"  # how Matroska marks VP8 and VP9 with transparency
_JITTER = 0.02  # of the usual interval; above the rounding of any sane time base
_DURATION_SLACK = 0.05


@dataclass(frozen=True)
class VideoProbe:
    """What a video file is, before anything is done with it."""

    container: str
    codec: str
    pix_fmt: str
    width: int  # as displayed: square pixels, upright
    height: int
    stored_width: int
    stored_height: int
    rotation: int  # degrees clockwise by which stored pictures are turned for display
    mirrored: bool
    pixel_aspect: float  # width of a stored pixel over its height
    declared_frames: int | None  # what the container says, None if it says nothing
    frames: int  # what the container really holds
    average_rate: float  # frames a second
    variable_rate: bool
    duration: float  # seconds
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class Video:
    """A scanned file: its probe and the time of every frame."""

    path: Path
    probe: VideoProbe
    pts: np.ndarray = field(repr=False)  # float64 [T], seconds from the first frame, increasing
    ticks: np.ndarray | None = field(repr=False)  # int64 [T], the container's own times; None if it has none
    pixel_aspect: Fraction
    orientation: Orientation


def scan(path: str | Path) -> Video:
    """Read a file's structure and the time of every frame; decodes one picture.

    Args:
        path: local video file.

    Returns:
        The scanned video, for `decode`.

    Raises:
        VideoError: the file cannot be used; see `ahoy_core.formats.errors`.
    """
    source = Path(path)
    with open_video(source) as container:
        timeline = timeline_of(container)
        facts = _container_facts(container)
    if not timeline.count:
        raise NoFramesError(f"expected pictures, got {source.name!r} whose video stream is empty: record it again")
    with open_video(source) as container:
        first = next(stored_frames(container, lambda _: None), None)
        if first is None:
            raise DamagedVideoError(
                f"expected pictures, got {source.name!r} in which none of {timeline.count} frames can be decoded: "
                "the file is damaged; copy or download it again"
            )
        return _assembled(source, container, first, timeline, facts)


def probe(path: str | Path) -> VideoProbe:
    """What a video file is. See `scan` for arguments and errors."""
    return scan(path).probe


def _container_facts(container: InputContainer) -> tuple[int, float | None]:
    """Declared number of frames (0 if none) and declared duration in seconds."""
    duration = container.duration / av.time_base if container.duration else None
    return video_stream(container).frames, duration


def _assembled(
    source: Path, container: InputContainer, first: av.VideoFrame, timeline: Timeline, facts: tuple[int, float | None]
) -> Video:
    stream = video_stream(container)
    rate = stream.average_rate or stream.guessed_rate or Fraction(25)
    timed = len(timeline.ticks) > 0
    if timed:
        seconds = np.array([float((int(t) - int(timeline.ticks[0])) * timeline.time_base) for t in timeline.ticks])
    else:
        seconds = np.arange(timeline.count) / float(rate)
    interval = float(np.median(np.diff(seconds))) if len(seconds) > 1 else float(1 / rate)
    duration = float(seconds[-1]) + interval
    orientation = orientation_of(first)
    aspect = stream.sample_aspect_ratio or Fraction(1)
    aspect = aspect if aspect > 0 else Fraction(1)
    size = square_pixel_size(first.width, first.height, aspect)
    width, height = size[::-1] if orientation.transpose else size
    result = VideoProbe(
        container=container.format.name,
        codec=stream.codec_context.name,
        pix_fmt=first.format.name,
        width=width,
        height=height,
        stored_width=first.width,
        stored_height=first.height,
        rotation=orientation.clockwise,
        mirrored=orientation.mirrored,
        pixel_aspect=float(aspect),
        declared_frames=facts[0] or None,
        frames=timeline.count,
        average_rate=len(seconds) / duration,
        variable_rate=_varies(seconds, interval, float(timeline.time_base)),
        duration=duration,
        warnings=tuple(_warnings(stream, first, timeline, facts, aspect, orientation, duration)),
    )
    return Video(source, result, seconds, timeline.ticks if timed else None, aspect, orientation)


def _varies(seconds: np.ndarray, interval: float, tick: float) -> bool:
    """Whether intervals differ by more than the rounding to the container's clock."""
    return len(seconds) > 2 and bool(np.max(np.abs(np.diff(seconds) - interval)) > max(1.5 * tick, _JITTER * interval))


def _warnings(
    stream: VideoStream,
    first: av.VideoFrame,
    timeline: Timeline,
    facts: tuple[int, float | None],
    aspect: Fraction,
    orientation: Orientation,
    duration: float,
) -> Iterator[str]:
    declared, declared_duration = facts
    if declared > timeline.packets:
        yield f"the file declares {declared} frames and holds {timeline.packets}: it was probably cut off"
    elif declared_duration and duration < declared_duration * (1 - _DURATION_SLACK) - 1:
        yield f"the file declares {declared_duration:.1f} s and its pictures end after {duration:.1f} s"
    if timeline.packets and not len(timeline.ticks):
        yield "frames carry no times of their own: times follow from the average rate"
    if has_alpha(first):
        yield "transparent places are composited over grey 0.5"
    elif stream.metadata.get(_ALPHA_TAG) == "1":
        yield "the transparency of this codec is not decoded: colours are taken as opaque"
    if aspect != 1:
        yield f"pixels are {float(aspect):.3f} times as wide as high: resized to square pixels"
    if not orientation.right_angle:
        yield "the rotation is no multiple of 90 degrees: the nearest one is used"
    if first.color_trc in _HDR_TRANSFERS:
        yield f"high dynamic range ({_HDR_TRANSFERS[first.color_trc]}) is not tone-mapped: colours will look flat"
    if first.interlaced_frame:
        yield "the video is interlaced and is not deinterlaced: edges in motion show combs"
