"""Video files: what is in them, their pictures upright and in order, and writing mp4."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import av
import numpy as np

from ahoy_core.formats.video_frames import Size, limited, to_rgb
from ahoy_core.formats.video_open import open_video
from ahoy_core.formats.video_packets import Warn, stored_frames
from ahoy_core.formats.video_probe import Video, VideoProbe, probe, scan
from ahoy_core.formats.video_write import write_mp4

__all__ = ["DecodedFrame", "Frame", "Video", "VideoProbe", "decode", "probe", "read_frames", "scan", "write_mp4"]


@dataclass(frozen=True)
class Frame:
    """One picture of a video."""

    index: int  # number in the source
    pts: float  # seconds from the first frame
    image: np.ndarray = field(repr=False)  # uint8 [H,W,3], sRGB, upright


@dataclass(frozen=True)
class DecodedFrame:
    """A decoded picture that has not been converted yet: conversion is the caller's choice."""

    index: int
    pts: float
    video: Video
    stored: av.VideoFrame = field(repr=False)

    def image(self, max_size: int | None = None) -> np.ndarray:
        """Upright RGB with square pixels.

        Args:
            max_size: longest side in pixels; larger pictures are reduced with an area filter in the same step, so that
                no full-size RGB copy exists. None keeps the size.

        Returns:
            uint8 [H,W,3], sRGB.
        """
        shown = limited(Size(self.video.probe.width, self.video.probe.height), max_size)
        turned = self.video.orientation
        return turned.apply(to_rgb(self.stored, Size(*shown[::-1]) if turned.transpose else shown))


def decode(video: Video, warn: Warn = lambda _: None) -> Iterator[DecodedFrame]:
    """Decode every picture in display order, without converting it.

    What does not decode is left out and reported; the frames' numbers stay those of the source.

    Args:
        video: from `scan`.
        warn: called with one sentence for each kind of trouble.

    Yields:
        Frames with increasing `index` and `pts`.
    """
    last, resized, misplaced = -1, False, 0
    with open_video(video.path) as container:
        for number, stored in enumerate(stored_frames(container, warn)):
            index = _index_of(video, stored, number)
            if not last < index < len(video.pts):
                misplaced += 1
                continue
            if (stored.width, stored.height) != (video.probe.stored_width, video.probe.stored_height) and not resized:
                resized = True
                warn(f"the size changes to {stored.width}x{stored.height} at frame {index}: resized as the first one")
            last = index
            yield DecodedFrame(index, float(video.pts[index]), video, stored)
    if misplaced:
        warn(f"{misplaced} frames outside the order of time were left out")


def read_frames(path: str | Path, *, max_size: int | None = None, warn: Warn = lambda _: None) -> Iterator[Frame]:
    """All pictures of a video, upright, with square pixels, in display order.

    Args:
        path: local video file.
        max_size: longest side in pixels, see `DecodedFrame.image`.
        warn: called with one sentence for each kind of trouble.

    Yields:
        index, pts in seconds from the first frame, uint8 RGB [H,W,3].

    Raises:
        VideoError: the file cannot be used.
    """
    for frame in decode(scan(path), warn):
        yield Frame(frame.index, frame.pts, frame.image(max_size))


def _index_of(video: Video, stored: av.VideoFrame, number: int) -> int:
    if video.ticks is None or stored.pts is None:
        return number
    return int(np.searchsorted(video.ticks, stored.pts, side="right")) - 1
