"""Packets of a video: when their pictures are shown, and decoding what can be decoded."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from fractions import Fraction

import av
import av.error
import numpy as np
from av.container import InputContainer
from av.video.stream import VideoStream

from ahoy_core.formats.video_open import set_threads, video_stream

Warn = Callable[[str], None]


@dataclass(frozen=True)
class Timeline:
    """When each picture of a stream is shown."""

    ticks: np.ndarray  # int64, increasing; empty if any packet has no time of its own
    count: int  # packets that hold a picture to be shown
    packets: int  # all of them, with those that an edit list hides
    time_base: Fraction


def timeline_of(container: InputContainer) -> Timeline:
    """Read all packets, decode none; stops without complaint where a cut-off file stops."""
    stream = video_stream(container)
    times: list[int | None] = []
    hidden = 0
    try:
        for packet in container.demux(stream):
            if not packet.size or packet.is_corrupt:
                continue
            if packet.is_discard:
                hidden += 1
            else:
                times.append(packet.pts)
    except (av.error.FFmpegError, OSError):
        pass  # a file cut off in the middle: what came before is still good
    ticks = np.unique(np.array([time for time in times if time is not None], np.int64))
    # Times that are missing or occur twice (recordings joined end to end) would lose frames: better none than those.
    trusted = ticks if len(ticks) == len(times) else ticks[:0]
    return Timeline(trusted, len(times), len(times) + hidden, Fraction(stream.time_base or 1))


def stored_frames(container: InputContainer, warn: Warn) -> Iterator[av.VideoFrame]:
    """Decode what decodes, in display order, and say at the end what did not.

    Args:
        container: opened and not yet read.
        warn: called with one sentence for each kind of trouble.

    Yields:
        Decoded frames, still in their stored form.
    """
    stream = video_stream(container)
    set_threads(stream)
    damaged = 0
    for packet in _packets(container, stream, warn):
        if packet is not None and packet.is_corrupt:
            damaged += 1
            continue
        try:
            frames = stream.decode(packet)
        except av.error.FFmpegError:
            damaged += packet is not None
            continue
        for frame in frames:
            if frame.is_corrupt:
                damaged += 1
            else:
                yield frame
    if damaged:
        warn(f"{damaged} damaged {'frame was' if damaged == 1 else 'frames were'} left out")


def _packets(container: InputContainer, stream: VideoStream, warn: Warn) -> Iterator[av.Packet[VideoStream] | None]:
    """All packets with content, then None, which makes the decoder give what it still holds."""
    try:
        for packet in container.demux(stream):
            if packet.size:
                yield packet
    except (av.error.FFmpegError, OSError) as error:
        warn(f"reading stopped before the end ({error}): only the frames before that are used")
    yield None
