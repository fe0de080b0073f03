"""Whatever is wrong with a file has its own error, and what can be used is used."""

from __future__ import annotations

import os
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from ahoy_core.formats import errors
from ahoy_core.formats.video import read_frames, scan
from ahoy_core.ingest import IngestConfig, ingest

from .clips import encode, moving, picture, psnr


def refused(path: Path | str, kind: type[errors.VideoError], *words: str) -> None:
    with pytest.raises(errors.VideoError) as caught:
        ingest(path)
    assert type(caught.value) is kind
    for word in ("expected", "got", *words):
        assert word in str(caught.value)


def test_missing_path_is_named(tmp_path: Path) -> None:
    refused(tmp_path / "nothing.mp4", errors.MissingVideoError, "nothing.mp4")


def test_address_is_not_fetched() -> None:
    refused("http://example.org/clip.mp4", errors.MissingVideoError, "download it first")


def test_folder_is_not_a_file(tmp_path: Path) -> None:
    refused(tmp_path, errors.NotAFileError, "folder")


def test_pipe_is_refused_without_waiting_for_it(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.mp4")
    refused(tmp_path / "pipe.mp4", errors.NotAFileError, "pipe")


def test_empty_file(tmp_path: Path) -> None:
    (tmp_path / "empty.mp4").touch()
    refused(tmp_path / "empty.mp4", errors.EmptyFileError, "0 bytes")


@pytest.mark.parametrize("name", ["notes.txt", "notes.mp4"])
def test_text_is_no_video_whatever_its_name(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("This is not a video.\n" * 100)
    with pytest.raises((errors.NotAVideoError, errors.RefusedContainerError), match="expected"):
        ingest(tmp_path / name)


def test_random_bytes_are_no_video(tmp_path: Path) -> None:
    (tmp_path / "noise.mp4").write_bytes(np.random.default_rng(0).bytes(20_000))
    with pytest.raises((errors.NotAVideoError, errors.RefusedContainerError), match="expected"):
        ingest(tmp_path / "noise.mp4")


@pytest.mark.parametrize("kind", ["png", "jpg", "bmp"])
def test_renamed_still_picture_is_recognised(tmp_path: Path, kind: str) -> None:
    cv2.imwrite(str(tmp_path / f"still.{kind}"), picture(32, 32))
    (tmp_path / f"still.{kind}").rename(tmp_path / "still.mp4")
    refused(tmp_path / "still.mp4", errors.StillImageError, "picture")


@pytest.mark.parametrize("name", ["list.m3u8", "list.mp4", "list.txt"])
@pytest.mark.parametrize("script", ["hls", "concat"])
def test_lists_that_name_other_files_are_refused(tmp_path: Path, name: str, script: str) -> None:
    target = encode(tmp_path / "private.mp4", moving(3))
    text = {
        "hls": f"#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\n{target}\n#EXT-X-ENDLIST\n",
        "concat": "ffconcat version 1.0\nfile 'private.mp4'\n",
    }[script]
    (tmp_path / name).write_text(text)
    refused(tmp_path / name, errors.RefusedContainerError, "names other files")


def test_sound_alone_has_no_pictures(tmp_path: Path) -> None:
    path = tmp_path / "sound.mp4"
    with av.open(str(path), "w") as output:
        stream = output.add_stream("aac", rate=16000)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
        frame.sample_rate = 16000
        output.mux(stream.encode(frame))
        output.mux(stream.encode())
    refused(path, errors.NoVideoStreamError, "audio")


def test_video_stream_without_frames(tmp_path: Path) -> None:
    path = tmp_path / "none.mkv"
    with av.open(str(path), "w") as output:
        stream = output.add_stream("ffv1", rate=25)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        output.start_encoding()
    refused(path, errors.NoFramesError, "empty")


def test_one_frame_is_enough(tmp_path: Path) -> None:
    result = ingest(encode(tmp_path / "one.mp4", [picture(48, 64)]))
    assert result.frames.shape == (1, 48, 64, 3)
    assert result.index.tolist() == [0] and result.pts.tolist() == [0.0] and result.shot.tolist() == [0]


@pytest.fixture
def intact(tmp_path: Path) -> Path:
    return encode(
        tmp_path / "intact.mp4", moving(40, 96, 128), options={"crf": "4", "g": "8"}, muxer={"movflags": "+faststart"}
    )


@pytest.mark.parametrize("share", [0.5, 0.75, 0.9])
def test_cut_off_video_gives_the_frames_that_are_left_unchanged(tmp_path: Path, intact: Path, share: float) -> None:
    whole = ingest(intact)
    data = intact.read_bytes()
    (tmp_path / "cut.mp4").write_bytes(data[: int(len(data) * share)])
    part = ingest(tmp_path / "cut.mp4")
    assert 0.3 * share * 40 < len(part.frames) < 40
    assert np.array_equal(part.index, np.arange(len(part.index)))
    assert np.array_equal(part.frames, whole.frames[: len(part.frames)])
    assert any("declares 40 frames" in note and "cut off" in note for note in part.notes)
    assert not any("order of time" in note for note in part.notes)


def test_cut_off_matroska_is_noticed_by_its_duration(tmp_path: Path) -> None:
    whole = encode(tmp_path / "whole.mkv", moving(100, 96, 128), options={"g": "8"})
    data = whole.read_bytes()
    (tmp_path / "cut.mkv").write_bytes(data[: len(data) // 3])
    part = ingest(tmp_path / "cut.mkv")
    assert 10 < len(part.frames) < 60
    assert any("declares 4.0 s" in note for note in part.notes)


def test_video_cut_off_before_its_index_says_so(tmp_path: Path) -> None:
    whole = encode(tmp_path / "late.mp4", moving(40))
    data = whole.read_bytes()
    (tmp_path / "cut.mp4").write_bytes(data[: len(data) * 2 // 3])
    refused(tmp_path / "cut.mp4", errors.DamagedVideoError, "index", "cut off")


def test_video_without_one_decodable_frame(tmp_path: Path, intact: Path) -> None:
    data = intact.read_bytes()
    start = data.index(b"mdat") + 4
    (tmp_path / "blank.mp4").write_bytes(data[:start] + b"\xff" * (len(data) - start))
    refused(tmp_path / "blank.mp4", errors.DamagedVideoError, "can be decoded")


def test_damaged_frame_is_left_out_and_the_others_keep_their_numbers(tmp_path: Path) -> None:
    pictures = moving(8)
    path = encode(tmp_path / "png.mov", pictures, codec="png", pix_fmt="rgb24")
    data = bytearray(path.read_bytes())
    with av.open(str(path)) as container:
        packet = next(p for i, p in enumerate(container.demux(video=0)) if i == 3)
        data[packet.pos : packet.pos + packet.size] = bytes(packet.size)
    path.write_bytes(data)
    result = ingest(path)
    assert result.index.tolist() == [0, 1, 2, 4, 5, 6, 7]
    assert np.allclose(result.pts, result.index / 25)
    assert all(np.array_equal(frame, pictures[i]) for frame, i in zip(result.frames, result.index, strict=True))
    assert any("damaged" in note for note in result.notes) and any("missing" in note for note in result.notes)


def test_half_blanked_frame_is_left_out_and_the_next_key_frame_is_whole_again(tmp_path: Path) -> None:
    path = encode(tmp_path / "clip.mp4", moving(30, 96, 128), options={"crf": "4", "g": "15", "bf": "0"})
    whole = ingest(path)
    data = bytearray(path.read_bytes())
    with av.open(str(path)) as container:
        packet = next(p for i, p in enumerate(container.demux(video=0)) if i == 10)
        half = packet.size // 2
        data[packet.pos + half : packet.pos + packet.size] = bytes(packet.size - half)
    path.write_bytes(data)
    result = ingest(path)
    assert result.index.tolist() == [i for i in range(30) if i != 10]
    assert np.array_equal(result.frames[14:], whole.frames[15:])


def test_range_in_which_nothing_decodes_is_an_error(tmp_path: Path) -> None:
    path = encode(tmp_path / "png.mov", moving(8), codec="png", pix_fmt="rgb24")
    data = bytearray(path.read_bytes())
    with av.open(str(path)) as container:
        for packet in list(container.demux(video=0))[4:8]:
            data[packet.pos : packet.pos + packet.size] = bytes(packet.size)
    path.write_bytes(data)
    with pytest.raises(errors.DamagedVideoError, match="choose another range"):
        ingest(path, IngestConfig(start_s=4 / 25))


@pytest.mark.parametrize("seed", range(12))
def test_random_damage_never_gives_anything_but_frames_or_a_video_error(
    tmp_path: Path, intact: Path, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    data = np.frombuffer(intact.read_bytes(), np.uint8).copy()
    where = rng.integers(8, len(data), rng.integers(1, 60))
    data[where] = rng.integers(0, 256, len(where))
    path = tmp_path / "damaged.mp4"
    path.write_bytes(data[: len(data) if seed % 2 else rng.integers(100, len(data))].tobytes())
    try:
        result = ingest(path)
    except errors.VideoError as error:
        assert "expected" in str(error)
    else:
        assert len(result.frames) == len(result.index) == len(result.pts) == len(result.shot) >= 1
        assert np.all(np.diff(result.index) > 0) and np.all(np.diff(result.pts) > 0)


def test_change_of_size_in_mid_stream_is_resized_and_said(tmp_path: Path) -> None:
    paths = [encode(tmp_path / f"{w}.ts", [picture(48, w)] * 5, container="mpegts") for w in (64, 96)]
    joined = tmp_path / "joined.ts"
    joined.write_bytes(b"".join(path.read_bytes() for path in paths))
    said: list[str] = []
    frames = list(read_frames(joined, warn=said.append))
    # The demuxer flags one packet at the seam as corrupt.
    assert [frame.index for frame in frames] == list(range(9)) and any("damaged" in sentence for sentence in said)
    assert {frame.image.shape for frame in frames} == {(48, 64, 3)}
    assert psnr(frames[-1].image, picture(48, 64)) > 20
    assert any("size changes" in sentence for sentence in said)


def test_oversized_header_is_refused_before_decoding(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ahoy_core.formats.video_open.MAX_PIXELS", 1000)
    refused(encode(tmp_path / "big.mp4", moving(2)), errors.OversizedVideoError, "64x48")


def test_unknown_codec_says_what_to_convert_to(tmp_path: Path) -> None:
    path = encode(tmp_path / "clip.mp4", moving(2))
    head, _, sample_table = path.read_bytes().partition(b"stsd")
    path.write_bytes(head + b"stsd" + sample_table.replace(b"avc1", b"zzzz", 1))
    refused(path, errors.UnsupportedCodecError, "convert it to H.264")


def test_scan_counts_what_is_there(tmp_path: Path, intact: Path) -> None:
    video = scan(intact)
    assert (video.probe.declared_frames, video.probe.frames, len(video.pts)) == (40, 40, 40)
    assert video.probe.codec == "h264" and video.probe.average_rate == pytest.approx(25) and not video.probe.warnings
