"""Every kind of video arrives upright, with square pixels, 8-bit, at the right times."""

from __future__ import annotations

import json
import struct
import tracemalloc
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from ahoy_core.formats.video import probe, read_frames
from ahoy_core.formats.video_frames import Orientation, Size, to_rgb
from ahoy_core.ingest import IngestConfig, ingest

from .clips import encode, moving, picture, psnr


def first(path: Path) -> np.ndarray:
    return next(iter(read_frames(path))).image


@pytest.mark.parametrize("rotation", [0, 90, 180, -90])
@pytest.mark.parametrize("hflip", [False, True])
def test_rotated_and_mirrored_clips_come_upright(tmp_path: Path, rotation: int, hflip: bool) -> None:
    stored = picture(48, 64)
    path = encode(tmp_path / "turned.mp4", [stored] * 2, rotation=rotation, hflip=hflip)
    # PyAV turns counter-clockwise and mirrors after that.
    expected = np.rot90(stored, rotation // 90)
    expected = expected[:, ::-1] if hflip else expected
    assert psnr(first(path), expected) > 35
    found = probe(path)
    assert (found.height, found.width) == expected.shape[:2]
    assert found.mirrored == hflip
    mirrored_first = stored[:, ::-1] if hflip else stored
    assert np.array_equal(np.rot90(mirrored_first, -found.rotation // 90), expected)


def test_track_matrix_of_a_phone_held_upright(tmp_path: Path) -> None:
    stored = picture(48, 64)
    path = encode(tmp_path / "phone.mp4", [stored] * 2)
    data = bytearray(path.read_bytes())
    matrix = data.index(b"tkhd") + 4 + 40  # ISO/IEC 14496-12, 8.3.2, version 0
    struct.pack_into(">9i", data, matrix, 0, 1 << 16, 0, -1 << 16, 0, 0, 48 << 16, 0, 1 << 30)
    path.write_bytes(data)
    assert psnr(first(path), np.rot90(stored, -1)) > 35
    result = ingest(path)
    assert result.probe.rotation == 90 and any("90 degrees clockwise" in note for note in result.notes)


def test_eight_orientations_are_eight_different_pictures() -> None:
    image = np.arange(6, dtype=np.uint8).reshape(2, 3, 1)
    flags = [(t, x, y) for t in (False, True) for x in (False, True) for y in (False, True)]
    turned = {(*Orientation(*f).apply(image).shape, Orientation(*f).apply(image).tobytes()) for f in flags}
    assert len(turned) == 8


@pytest.mark.parametrize(
    ("codec", "pix_fmt", "suffix"),
    [
        ("libx264", "yuv420p10le", "mp4"),
        ("libx264", "yuv422p", "mp4"),
        ("libx264", "yuv422p10le", "mkv"),
        ("libx264", "yuv444p", "mp4"),
        ("libx265", "yuv420p10le", "mp4"),
        ("prores_ks", "yuv422p10le", "mov"),
        ("mjpeg", "yuvj420p", "avi"),
        ("mpeg4", "yuv420p", "avi"),
        ("libvpx-vp9", "yuv420p", "webm"),
        ("ffv1", "yuv420p16le", "mkv"),
        ("libx264", "yuv420p", "ts"),
        ("libx264", "gray", "mp4"),
    ],
)
def test_depths_and_chroma_formats_keep_their_colours(tmp_path: Path, codec: str, pix_fmt: str, suffix: str) -> None:
    original = picture(96, 128)
    if pix_fmt == "gray":
        original = np.repeat(
            (original @ np.array([0.299, 0.587, 0.114])).round().astype(np.uint8)[..., None], 3, axis=2
        )
    options = {
        "libvpx-vp9": {"crf": "8", "b:v": "0"},
        "mjpeg": {"q": "2"},
        "mpeg4": {"b": "4M"},
        "libx265": {"crf": "8"},
    }
    path = encode(tmp_path / f"clip.{suffix}", [original] * 3, codec=codec, pix_fmt=pix_fmt, options=options.get(codec))
    frames = [frame.image for frame in read_frames(path)]
    assert len(frames) == 3
    # A wrong matrix or range shifts whole areas by 5 levels and more; 4:2:0 costs decibels at the white corner's edges.
    assert psnr(frames[0], original) > 30
    assert np.abs(frames[0].astype(int) - original).mean() < 2.5


@pytest.mark.parametrize(("height", "width"), [(47, 63), (1, 1), (3, 17), (48, 63)])
def test_odd_sizes_are_exact(tmp_path: Path, height: int, width: int) -> None:
    original = np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)
    path = encode(tmp_path / "odd.mkv", [original], codec="ffv1", pix_fmt="bgr0")
    assert np.array_equal(first(path), original)


def test_variable_rate_keeps_every_time_exactly(tmp_path: Path) -> None:
    times = [0, 40, 55, 140, 141, 900]
    path = encode(tmp_path / "vfr.mp4", moving(6), times=times)
    result = ingest(path)
    assert np.abs(result.pts - np.array(times) / 1000).max() < 1e-9
    assert result.probe.variable_rate and any("varies" in note for note in result.notes)


@pytest.mark.parametrize("suffix", ["mp4", "mkv", "ts"])
def test_constant_rate_is_not_called_variable_by_a_coarse_clock(tmp_path: Path, suffix: str) -> None:
    path = encode(tmp_path / f"cfr.{suffix}", moving(30), rate=24)
    assert not probe(path).variable_rate
    assert np.abs(ingest(path).pts - np.arange(30) / 24).max() < 1e-3


def test_times_begin_at_zero_wherever_the_container_begins(tmp_path: Path) -> None:
    path = encode(tmp_path / "late.mkv", moving(4), times=[5000, 5040, 5080, 5120], codec="ffv1", pix_fmt="bgr0")
    assert np.allclose(ingest(path).pts, [0, 0.04, 0.08, 0.12])


@pytest.mark.parametrize(("codec", "pix_fmt"), [("png", "rgba"), ("qtrle", "argb"), ("prores_ks", "yuva444p10le")])
def test_transparency_is_composited_over_grey(tmp_path: Path, codec: str, pix_fmt: str) -> None:
    image = picture(48, 64)
    alpha = np.broadcast_to(np.linspace(0, 255, 64).round().astype(np.uint8)[None, :, None], (48, 64, 1))
    path = encode(tmp_path / "alpha.mov", [np.concatenate([image, alpha], axis=2)] * 2, codec=codec, pix_fmt=pix_fmt)
    share = alpha / 255.0
    expected = (image * share + 128 * (1 - share)).round().astype(np.uint8)
    result = ingest(path)
    assert psnr(result.frames[0], expected) > (35 if codec == "prores_ks" else 50)
    assert any("grey 0.5" in note for note in result.notes)


def test_transparency_that_is_not_decoded_is_said(tmp_path: Path) -> None:
    rgba = np.concatenate([picture(48, 64), np.full((48, 64, 1), 90, np.uint8)], axis=2)
    path = encode(tmp_path / "alpha.webm", [rgba] * 2, codec="libvpx-vp9", pix_fmt="yuva420p")
    assert any("opaque" in note or "grey 0.5" in note for note in ingest(path).notes)


@pytest.mark.parametrize(("aspect", "shape"), [(Fraction(2), (48, 128)), (Fraction(1, 2), (96, 64))])
@pytest.mark.parametrize("rotation", [None, 90])
def test_pixels_become_square(tmp_path: Path, aspect: Fraction, shape: tuple[int, int], rotation: int | None) -> None:
    path = encode(tmp_path / "wide.mp4", [picture(48, 64)] * 2, pixel_aspect=aspect, rotation=rotation)
    result = ingest(path)
    assert result.frames.shape[1:3] == (shape if rotation is None else shape[::-1])
    assert any("square" in note for note in result.notes)
    upright = result.frames[0] if rotation is None else np.rot90(result.frames[0], -1)
    assert psnr(upright, picture(*shape)) > 20


def test_8k_is_reduced_without_ever_existing_in_rgb(tmp_path: Path) -> None:
    small = picture(54, 96)
    large = np.repeat(np.repeat(small, 80, axis=0), 80, axis=1)
    path = encode(tmp_path / "8k.mp4", [large] * 2, options={"preset": "ultrafast", "crf": "20"})
    del large
    tracemalloc.start()
    result = ingest(path, IngestConfig(max_size=480))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert result.frames.shape == (2, 270, 480, 3)
    assert (result.probe.width, result.probe.height) == (7680, 4320)
    assert any("7680x4320 to 480x270" in note and "very large" in note for note in result.notes)
    # One full-size RGB picture alone has 99 MB; numpy reports its arrays to tracemalloc.
    assert peak < 20e6
    expected = np.repeat(np.repeat(small, 5, axis=0), 5, axis=1)
    assert psnr(result.frames[0], expected) > 30


def test_reduction_averages_and_does_not_alias(tmp_path: Path) -> None:
    stripes = np.zeros((256, 256, 3), np.uint8)
    stripes[:, ::2] = 200
    path = encode(tmp_path / "stripes.mkv", [stripes], codec="ffv1", pix_fmt="bgr0")
    frame = ingest(path, IngestConfig(max_size=64)).frames[0]
    assert np.abs(frame.astype(int) - 100).max() <= 2


def test_small_video_is_not_enlarged(tmp_path: Path) -> None:
    result = ingest(encode(tmp_path / "small.mp4", moving(2)), IngestConfig(max_size=512))
    assert result.frames.shape[1:3] == (48, 64)
    assert not any("reduced" in note for note in result.notes)


def test_summary_is_plain_json(tmp_path: Path) -> None:
    result = ingest(encode(tmp_path / "clip.mp4", moving(3)))
    again = json.loads(json.dumps(result.summary(), allow_nan=False))
    assert again["probe"]["codec"] == "h264" and again["frames"] == 3 and again["shots"] == 1


def test_angle_that_is_no_right_angle_takes_the_nearest_and_says_so(tmp_path: Path) -> None:
    stored = picture(48, 64)
    result = ingest(encode(tmp_path / "tilted.mp4", [stored] * 2, rotation=80))
    assert psnr(result.frames[0], np.rot90(stored)) > 35
    assert any("no multiple of 90" in note for note in result.notes)


@pytest.mark.parametrize(("transfer", "name"), [(16, "PQ"), (18, "HLG"), (1, None)])
def test_high_dynamic_range_is_said(tmp_path: Path, transfer: int, name: str | None) -> None:
    path = encode(tmp_path / "hdr.mp4", moving(2), pix_fmt="yuv420p10le", transfer=transfer)
    warnings = [text for text in probe(path).warnings if "tone-mapped" in text]
    assert len(warnings) == (name is not None) and all(str(name) in text for text in warnings)


def test_interlacing_is_said(tmp_path: Path) -> None:
    path = encode(tmp_path / "combs.mp4", moving(4), options={"x264-params": "interlaced=1"})
    assert any("interlaced" in text for text in probe(path).warnings)


@pytest.mark.parametrize(("lines", "kr", "kb"), [(480, 0.299, 0.114), (720, 0.2126, 0.0722)])
def test_untagged_video_is_read_by_its_number_of_lines(lines: int, kr: float, kb: float) -> None:
    y, cb, cr = 120, 100, 160
    planes = np.full((lines * 3 // 2, 1280), y, np.uint8)
    planes[lines : lines * 5 // 4], planes[lines * 5 // 4 :] = cb, cr
    frame = av.VideoFrame.from_ndarray(planes, format="yuv420p")
    luma, blue, red = (y - 16) / 219, (cb - 128) / 224, (cr - 128) / 224
    r, b = luma + 2 * (1 - kr) * red, luma + 2 * (1 - kb) * blue
    g = (luma - kr * r - kb * b) / (1 - kr - kb)
    assert np.abs(to_rgb(frame, Size(64, 36)).reshape(-1, 3) - 255 * np.array([r, g, b])).max() < 2
