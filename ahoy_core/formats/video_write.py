"""Writing mp4 files that play everywhere."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping
from fractions import Fraction
from pathlib import Path

import av
import av.error
import av.filter
import numpy as np
from av.video.reformatter import ColorRange

from ahoy_core.formats.atomic import atomic_path

# The keys that the mp4 muxer stores; it would drop any other without a word.
METADATA_KEYS = (
    "title",
    "artist",
    "album",
    "comment",
    "genre",
    "copyright",
    "description",
    "synopsis",
    "date",
)
_BT709 = 1
_SCALER_FLAGS = "bicubic+accurate_rnd+full_chroma_inp"
_MAX_RATE_DENOMINATOR = 100_000


def write_mp4(
    path: str | Path,
    frames: Iterable[np.ndarray],
    fps: float | Fraction,
    *,
    crf: int = 18,
    preset: str = "medium",
    metadata: Mapping[str, str] | None = None,
) -> int:
    """Write H.264 in 4:2:0 (BT.709, limited range), index first, so that browsers play it while loading.

    4:2:0 needs even sides: an odd width or height gets one more column or row, a copy of the last.

    Args:
        path: target; replaced only when the new file is complete.
        frames: uint8 RGB [H,W,3] each, all of one size; may be a generator (one frame is held at a time).
        fps: frames a second, above 0.
        crf: quality, 0 (lossless but for the halved colour resolution) to 51 (worst).
        preset: how hard the encoder tries, "ultrafast" to "veryslow".
        metadata: values of `METADATA_KEYS`, e.g. a `comment` that says the video is synthetic.

    Returns:
        The number of frames written.

    Raises:
        ValueError: no frames, a wrong shape or dtype, sizes that differ, a bad rate, quality or key.
        OSError: the file could not be written, e.g. the disk is full; the older file stays.
    """
    rate = _checked_rate(fps)
    _check_settings(crf, metadata or {})
    pictures = iter(frames)
    first = next(pictures, None)
    if first is None:
        raise ValueError("expected at least one frame, got none")
    _check_frame(first, first.shape, 0)
    with atomic_path(path) as temporary:
        try:
            return _encode(temporary, first, pictures, rate, {"crf": str(crf), "preset": preset}, metadata or {})
        except av.error.FFmpegError as error:
            raise OSError(f"writing {Path(path).name!r} failed ({error}): is the disk full?") from error


def _encode(
    temporary: Path,
    first: np.ndarray,
    rest: Iterable[np.ndarray],
    rate: Fraction,
    options: dict[str, str],
    metadata: Mapping[str, str],
) -> int:
    height, width = first.shape[:2]
    written = 0
    with av.open(str(temporary), "w", format="mp4", container_options={"movflags": "+faststart"}) as container:
        container.metadata.update(metadata)
        stream = container.add_stream("libx264", rate=rate, options=options)
        stream.width, stream.height, stream.pix_fmt = width + width % 2, height + height % 2, "yuv420p"
        context = stream.codec_context
        context.colorspace = context.color_primaries = context.color_trc = _BT709
        context.color_range = ColorRange.MPEG
        to_yuv = _converter(stream.width, stream.height)
        for image in itertools.chain([first], rest):
            _check_frame(image, first.shape, written)
            picture = to_yuv(image)
            picture.pts, picture.time_base = written, 1 / rate
            container.mux(stream.encode(picture))
            written += 1
        container.mux(stream.encode())
    return written


def _converter(width: int, height: int) -> Callable[[np.ndarray], av.VideoFrame]:
    """Conversion of RGB to 4:2:0 of an even size.

    `VideoFrame.reformat` would put colour samples in the middle of four pixels. Players expect them at the left, as
    H.264 prescribes unless told otherwise, and would show colours half a pixel aside (11 dB worse).
    """
    graph = av.filter.Graph()
    graph.link_nodes(
        graph.add_buffer(width=width, height=height, format=av.VideoFormat("rgb24"), time_base=Fraction(1, 1)),
        graph.add("scale", f"out_color_matrix=bt709:out_range=tv:out_chroma_loc=left:flags={_SCALER_FLAGS}"),
        graph.add("format", "yuv420p"),
        graph.add("buffersink"),
    ).configure()

    def convert(image: np.ndarray) -> av.VideoFrame:
        rows, columns = image.shape[:2]
        if rows % 2 or columns % 2:
            image = np.pad(image, ((0, rows % 2), (0, columns % 2), (0, 0)), mode="edge")
        graph.vpush(av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24"))
        return graph.vpull()

    return convert


def _check_settings(crf: int, metadata: Mapping[str, str]) -> None:
    if not 0 <= crf <= 51:
        raise ValueError(f"expected crf in 0..51, got {crf}")
    unknown = sorted(set(metadata) - set(METADATA_KEYS))
    if unknown:
        raise ValueError(f"expected metadata keys among {', '.join(METADATA_KEYS)}, got {', '.join(unknown)}")


def _checked_rate(fps: float | Fraction) -> Fraction:
    if not 0 < fps < _MAX_RATE_DENOMINATOR:
        raise ValueError(f"expected a rate above 0 frames a second, got {fps}")
    return Fraction(fps).limit_denominator(_MAX_RATE_DENOMINATOR)


def _check_frame(image: np.ndarray, shape: tuple[int, ...], number: int) -> None:
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or not image.size:
        raise ValueError(f"expected uint8 [H,W,3], got {image.dtype} {list(image.shape)} as frame {number}")
    if image.shape != shape:
        raise ValueError(f"expected all frames of size {list(shape)}, got {list(image.shape)} as frame {number}")
