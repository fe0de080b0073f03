"""What is written as mp4 plays back as what it was, completely or not at all."""

from __future__ import annotations

import resource
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from ahoy_core.formats.video import probe, read_frames, write_mp4


def pictures(count: int, height: int = 64, width: int = 96) -> list[np.ndarray]:
    coarse = np.random.default_rng(0).integers(20, 235, (5, 7, 3), dtype=np.uint8)
    wide = cv2.resize(coarse, (width + count, height), interpolation=cv2.INTER_CUBIC)
    return [np.ascontiguousarray(wide[:, i : i + width]) for i in range(count)]


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / np.mean((a.astype(float) - b.astype(float)) ** 2)))


@pytest.mark.parametrize(("crf", "least"), [(0, 48), (10, 43), (18, 40), (35, 25)])
def test_round_trip_keeps_pictures_number_and_times(tmp_path: Path, crf: int, least: float) -> None:
    originals = pictures(12)
    assert write_mp4(tmp_path / "clip.mp4", iter(originals), 12.5, crf=crf) == 12
    frames = list(read_frames(tmp_path / "clip.mp4"))
    assert len(frames) == 12
    assert min(psnr(frame.image, original) for frame, original in zip(frames, originals, strict=True)) > least
    assert np.allclose([frame.pts for frame in frames], np.arange(12) / 12.5)


@pytest.mark.parametrize("colour", [(255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 255), (0, 0, 0), (128, 128, 128)])
def test_colours_survive_within_three_levels(tmp_path: Path, colour: tuple[int, int, int]) -> None:
    original = np.full((32, 32, 3), colour, np.uint8)
    write_mp4(tmp_path / "colour.mp4", [original], 10, crf=4)
    frame = next(iter(read_frames(tmp_path / "colour.mp4"))).image
    # 8-bit limited-range YUV has steps of up to 2.2 levels; the wrong matrix would be 20 and more off.
    assert np.abs(frame.astype(int) - original).max() <= 3


def test_better_quality_costs_more_bytes(tmp_path: Path) -> None:
    sizes = []
    for crf in (10, 20, 30):
        write_mp4(tmp_path / "clip.mp4", pictures(8), 25, crf=crf)
        sizes.append((tmp_path / "clip.mp4").stat().st_size)
    assert sizes[0] > sizes[1] > sizes[2]


@pytest.mark.parametrize(("height", "width"), [(63, 97), (64, 97), (63, 96), (1, 1)])
def test_odd_sides_get_a_copy_of_the_last_row_or_column(tmp_path: Path, height: int, width: int) -> None:
    original = pictures(1, height, width)[0]
    write_mp4(tmp_path / "odd.mp4", [original], 25, crf=4)
    frame = next(iter(read_frames(tmp_path / "odd.mp4"))).image
    assert frame.shape == (height + height % 2, width + width % 2, 3)
    assert psnr(frame, np.pad(original, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")) > 33


def test_players_get_the_index_first_and_a_common_format(tmp_path: Path) -> None:
    write_mp4(tmp_path / "clip.mp4", pictures(5), Fraction(30000, 1001))
    data = (tmp_path / "clip.mp4").read_bytes()
    assert data.index(b"moov") < data.index(b"mdat")
    found = probe(tmp_path / "clip.mp4")
    assert (found.codec, found.pix_fmt) == ("h264", "yuv420p")
    assert found.average_rate == pytest.approx(30000 / 1001, rel=1e-4) and not found.variable_rate


def test_metadata_can_be_read_back(tmp_path: Path) -> None:
    note = "synthetic media: rendered avatar, not a recording – 合成"
    write_mp4(tmp_path / "clip.mp4", pictures(2), 25, metadata={"comment": note, "title": "turntable"})
    with av.open(str(tmp_path / "clip.mp4")) as container:
        assert container.metadata["comment"] == note and container.metadata["title"] == "turntable"


def test_metadata_that_mp4_would_drop_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"expected metadata keys among .*got provenance"):
        write_mp4(tmp_path / "clip.mp4", pictures(1), 25, metadata={"provenance": "x"})


def test_every_accepted_metadata_key_is_stored(tmp_path: Path) -> None:
    from ahoy_core.formats.video_write import METADATA_KEYS

    wanted = {key: f"value of {key}" for key in METADATA_KEYS}
    write_mp4(tmp_path / "clip.mp4", pictures(1), 25, metadata=wanted)
    with av.open(str(tmp_path / "clip.mp4")) as container:
        assert {key: container.metadata.get(key) for key in wanted} == wanted


def test_failing_source_leaves_the_older_file_and_no_rest(tmp_path: Path) -> None:
    target = tmp_path / "clip.mp4"
    target.write_bytes(b"older")

    def failing() -> Iterator[np.ndarray]:
        yield from pictures(5)
        raise RuntimeError("renderer broke")

    with pytest.raises(RuntimeError, match="renderer broke"):
        write_mp4(target, failing(), 25)
    assert target.read_bytes() == b"older" and list(tmp_path.iterdir()) == [target]


def test_full_disk_is_an_os_error_and_leaves_the_older_file(tmp_path: Path) -> None:
    target = tmp_path / "clip.mp4"
    target.write_bytes(b"older")
    noise = np.random.default_rng(0).integers(0, 256, (10, 256, 256, 3), dtype=np.uint8)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    # A limit on file size fails in write(2) as a full disk does.
    resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, limits[1]))
    try:
        with pytest.raises(OSError, match=r"clip\.mp4.*disk full"):
            write_mp4(target, noise, 25, crf=4)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert target.read_bytes() == b"older" and list(tmp_path.iterdir()) == [target]


@pytest.mark.parametrize(
    ("frames", "fps", "crf", "words"),
    [
        ([], 25, 18, "at least one frame"),
        ([np.zeros((4, 4), np.uint8)], 25, 18, r"expected uint8 \[H,W,3\]"),
        ([np.zeros((4, 4, 3))], 25, 18, "float64"),
        ([np.zeros((4, 4, 3), np.uint8), np.zeros((4, 6, 3), np.uint8)], 25, 18, "as frame 1"),
        ([np.zeros((4, 4, 3), np.uint8)], 0, 18, "rate"),
        ([np.zeros((4, 4, 3), np.uint8)], float("nan"), 18, "rate"),
        ([np.zeros((4, 4, 3), np.uint8)], 25, 60, "crf"),
    ],
)
def test_bad_arguments_say_what_was_expected(
    tmp_path: Path, frames: list[np.ndarray], fps: float, crf: int, words: str
) -> None:
    with pytest.raises(ValueError, match=words):
        write_mp4(tmp_path / "clip.mp4", frames, fps, crf=crf)
    assert not list(tmp_path.iterdir())


def test_missing_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="create it first"):
        write_mp4(tmp_path / "no" / "clip.mp4", pictures(1), 25)
