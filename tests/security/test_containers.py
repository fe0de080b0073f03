"""No file makes FFmpeg open anything but itself: not another file, not an address."""

from __future__ import annotations

import contextlib
from pathlib import Path

import av
import pytest

from ahoy_core.formats.errors import VideoError
from ahoy_core.formats.video_open import DEMUXERS, open_video
from ahoy_core.ingest import ingest
from tasks.errors import BadInputError
from tasks.sources import SourcePolicy, fetch_source
from tests.sources.server import Served

from .hostile import Hostile, that_ask, that_read

ASKING = [sample.name for sample in that_ask("http://127.0.0.1/")]
READING = ["list.m3u8", "relative.mp4", "script.mp4", "reference.mov", "stream.sdp", "private.idx", "graph.mp4"]
# Containers that carry a whole video of their own beside the trap: they open, and the trap stays shut.
CARRIERS = {"subtitles.avi"}


def hostile(server: Served, clip: bytes, name: str) -> Hostile:
    server.file("/secret.ts", clip)
    return next(sample for sample in that_ask(server.url("/secret.ts")) if sample.name == name)


def written(sample: Hostile, folder: Path) -> Path:
    path = folder / sample.name
    path.write_bytes(sample.content)
    return path


def read_all(path: Path, kind: str | None, options: dict[str, str]) -> int:
    with av.open(f"file:{path}", format=kind, container_options=options) as container:
        return sum(1 for _ in container.decode(video=0))


@pytest.mark.parametrize("name", ASKING)
def test_no_address_is_asked_by_a_hostile_file(server: Served, clip: bytes, tmp_path: Path, name: str) -> None:
    path = written(hostile(server, clip, name), tmp_path)
    if name in CARRIERS:
        assert len(ingest(path).frames) == 1
    else:
        with pytest.raises(VideoError, match="expected"):
            ingest(path)
    assert server.requests == []


@pytest.mark.parametrize("name", [s.name for s in that_ask("") if s.unguarded is not None])
def test_the_same_files_do_ask_when_nothing_guards_ffmpeg(
    server: Served, clip: bytes, tmp_path: Path, name: str
) -> None:
    """The counterpart that shows the traps to be real: without it zero requests would prove nothing."""
    sample = hostile(server, clip, name)
    assert sample.unguarded is not None
    # What is served need not be what the format wants; that it was asked for is what counts.
    with contextlib.suppress(av.error.FFmpegError):
        read_all(written(sample, tmp_path), sample.kind, sample.unguarded)
    assert server.asked("/secret.ts") >= 1


@pytest.mark.parametrize("name", ASKING)
def test_no_address_is_asked_by_a_hostile_file_that_was_fetched(
    server: Served, clip: bytes, policy: SourcePolicy, cache: Path, name: str
) -> None:
    sample = hostile(server, clip, name)
    url = server.file("/clip.mp4", sample.content, Content_Type="video/mp4")
    try:
        ingest(fetch_source(url, policy, cache).path)
    except (VideoError, BadInputError):
        assert name not in CARRIERS
    assert server.asked("/clip.mp4") == 1 and len(server.requests) == 1


@pytest.mark.parametrize("name", READING)
def test_no_other_file_is_read_by_a_hostile_file(tmp_path: Path, name: str) -> None:
    samples = {sample.name: sample for sample in that_read(tmp_path)}
    with pytest.raises(VideoError, match="expected"):
        ingest(written(samples[name], tmp_path))


@pytest.mark.parametrize("name", ["list.m3u8", "relative.mp4", "script.mp4", "reference.mov"])
def test_the_same_files_do_read_others_when_nothing_guards_ffmpeg(tmp_path: Path, name: str) -> None:
    samples = {sample.name: sample for sample in that_read(tmp_path)}
    sample = samples[name]
    assert sample.unguarded is not None
    assert read_all(written(sample, tmp_path), sample.kind, sample.unguarded) == 3


def test_a_name_with_a_pattern_is_one_file_not_a_sequence(tmp_path: Path) -> None:
    import cv2
    import numpy as np

    for number in range(3):
        cv2.imwrite(str(tmp_path / f"frame{number}.png"), np.zeros((16, 16, 3), np.uint8))
    with pytest.raises(VideoError, match="does not exist"):
        ingest(tmp_path / "frame%d.png")
    (tmp_path / "frame%d.png").write_bytes((tmp_path / "frame0.png").read_bytes())
    with pytest.raises(VideoError, match="PNG picture"):
        ingest(tmp_path / "frame%d.png")


@pytest.mark.parametrize(
    "name", ["http://127.0.0.1:{port}/secret.ts", "concat:{a}|{a}", "subfile,,start,0,end,9,,:{a}"]
)
def test_a_path_is_never_taken_for_a_protocol(server: Served, clip: bytes, tmp_path: Path, name: str) -> None:
    (tmp_path / "a.mp4").write_bytes(clip)
    with pytest.raises(VideoError, match="does not exist"):
        open_video(name.format(port=server.port, a=tmp_path / "a.mp4"))
    assert server.requests == []


def test_the_list_of_demuxers_holds_none_that_names_others() -> None:
    naming = {
        "hls", "concat", "dash", "imf", "sdp", "rtsp", "rtp", "sap", "image2", "image2pipe", "lavfi", "vobsub",
        "webm_dash_manifest", "ffmetadata", "tty", "data", "v4l2", "x11grab", "fbdev", "kmsgrab", "alsa", "avisynth",
    }  # fmt: skip
    assert not naming & set(DEMUXERS)
    with pytest.raises(VideoError):
        open_video("/dev/video0")
