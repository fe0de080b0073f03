"""Opening a video file safely: one local file, known containers, nothing that leads elsewhere."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import av
import av.error
from av.container import InputContainer
from av.video.stream import VideoStream

from ahoy_core.formats.errors import (
    DamagedVideoError,
    EmptyFileError,
    MissingVideoError,
    NoFramesError,
    NotAFileError,
    NotAVideoError,
    NoVideoStreamError,
    OversizedVideoError,
    RefusedContainerError,
    StillImageError,
    UnsupportedCodecError,
)
from ahoy_core.formats.sniff import HEAD_BYTES, names_other_files, still_kind

# Containers that hold their own data. Playlists, concat scripts, image sequences and devices are not among them: they
# name other files or addresses, and a list of videos may come from strangers.
DEMUXERS = ("mov", "mp4", "matroska", "webm", "avi", "mpegts", "mpeg", "flv", "asf", "ogg", "mxf", "ivf", "gif")
MAX_PIXELS = 2**27  # four times 8K; beyond that a forged header could exhaust the memory
_MAX_THREADS = 4  # each decoding thread holds a full-size picture


def open_video(path: str | Path) -> InputContainer:
    """Open a local video file.

    Args:
        path: a regular file; addresses are not accepted.

    Returns:
        An open container with a video stream and a decoder; close it.

    Raises:
        VideoError: one of its subclasses, saying what the file is instead.
    """
    source = Path(path)
    _check_file(source)
    try:
        container = av.open(
            f"file:{source.absolute()}",
            container_options={
                "format_whitelist": ",".join(DEMUXERS),
                "protocol_whitelist": "file",
                "enable_drefs": "0",
            },
            metadata_errors="replace",
        )
    except (av.error.FFmpegError, OSError) as error:
        if isinstance(error, PermissionError) and not os.access(source, os.R_OK):
            raise
        raise _why_not_opened(source, error) from error
    try:
        _check_streams(source, container)
    except BaseException:
        container.close()
        raise
    return container


def video_stream(container: InputContainer) -> VideoStream:
    """The container's main moving picture (cover art does not count)."""
    return _moving(container)[0]


def set_threads(stream: VideoStream) -> None:
    """Let a stream that has not been decoded yet use a few threads."""
    stream.thread_type = "AUTO"
    stream.codec_context.thread_count = min(_MAX_THREADS, os.cpu_count() or 1)


def _moving(container: InputContainer) -> list[VideoStream]:
    return [s for s in container.streams.video if not s.disposition & type(s.disposition).attached_pic]


def _check_file(source: Path) -> None:
    try:
        mode = source.stat().st_mode
    except OSError as error:
        hint = (
            "download it first and give the file" if "://" in str(source) or ":/" in str(source) else "check the path"
        )
        raise MissingVideoError(
            f"expected a local video file, got {str(source)!r}, which does not exist: {hint}"
        ) from error
    if stat.S_ISDIR(mode):
        raise NotAFileError(f"expected a video file, got the folder {str(source)!r}: give the files in it one by one")
    if not stat.S_ISREG(mode):
        raise NotAFileError(f"expected a regular file, got the pipe or device {str(source)!r}: save it to a file first")
    if source.stat().st_size == 0:
        raise EmptyFileError(f"expected a video, got {source.name!r} with 0 bytes: copy or download it again")


def _why_not_opened(source: Path, error: Exception) -> Exception:
    with source.open("rb") as handle:
        head = handle.read(HEAD_BYTES)
    still = still_kind(head)
    if still:
        return StillImageError(f"expected a video, got {source.name!r}, which is a {still} picture: give a video file")
    if names_other_files(head):
        return RefusedContainerError(
            f"expected a self-contained video, got {source.name!r}, which is a list that names other files: "
            "give the video files themselves"
        )
    if head[4:8] in (b"ftyp", b"moov", b"mdat", b"wide", b"free"):
        return DamagedVideoError(
            f"expected a complete video, got {source.name!r}, whose index (moov) is missing or damaged: "
            "the file was probably cut off; copy or download it again"
        )
    if isinstance(error, av.error.EOFError):
        return NoFramesError(
            f"expected pictures, got {source.name!r}, which ends after its header and is empty: record or copy it again"
        )
    if isinstance(error, av.error.ArgumentError):
        return RefusedContainerError(
            f"expected one of the containers {', '.join(DEMUXERS)}, got {source.name!r}, which is something else: "
            "convert it to mp4"
        )
    return NotAVideoError(
        f"expected a video, got {source.name!r}, whose content is not a video's ({error}): check the file"
    )


def _check_streams(source: Path, container: InputContainer) -> None:
    moving = _moving(container)
    if not moving:
        kinds = sorted({str(stream.type) for stream in container.streams}) or ["nothing"]
        raise NoVideoStreamError(
            f"expected a video stream, got {source.name!r} with only {', '.join(kinds)}: "
            "give a file with moving pictures"
        )
    context = moving[0].codec_context
    if context is None:
        raise UnsupportedCodecError(
            f"expected a known codec, got {source.name!r} with none we can decode: convert it to H.264"
        )
    if context.width * context.height > MAX_PIXELS:
        raise OversizedVideoError(
            f"expected at most {MAX_PIXELS} pixels a picture, got {context.width}x{context.height} in {source.name!r}: "
            "reduce it first"
        )
