"""Cuts are found where they are, and nowhere else."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from ahoy_core.ingest import IngestConfig, ShotDetector, ingest

from .clips import encode, moving, picture


def scene(count: int, seed: int, step: float = 0.5, size: tuple[int, int] = (54, 96)) -> list[np.ndarray]:
    """A camera that moves over a large random picture by `step` pixels a frame."""
    rng = np.random.default_rng(seed)
    height, width = size
    total = width + int(abs(step) * count) + 2
    coarse = rng.integers(0, 256, (7, max(4, total // 14), 3), dtype=np.uint8)
    wide = cv2.resize(coarse, (total, height), interpolation=cv2.INTER_CUBIC)
    noise = np.random.default_rng(seed + 1000)
    views = [wide[:, int(i * step) : int(i * step) + width].astype(float) for i in range(count)]
    return [np.clip(v + noise.normal(0, 4, v.shape), 0, 255).astype(np.uint8) for v in views]


def cuts(pictures: list[np.ndarray]) -> list[int]:
    detector = ShotDetector()
    for image in pictures:
        detector.add(image)
    return detector.cuts()


@pytest.mark.parametrize("lengths", [(20, 20), (5, 30, 9), (40, 7, 7, 7, 40), (4, 4), (1, 12), (12, 1)])
def test_cuts_between_scenes_are_found_exactly(lengths: tuple[int, ...]) -> None:
    pictures = [image for seed, length in enumerate(lengths) for image in scene(length, seed)]
    assert cuts(pictures) == np.cumsum(lengths[:-1]).tolist()


def test_cut_between_two_framings_of_one_room_is_found() -> None:
    room = scene(1, 3, size=(108, 192))[0]
    wide = cv2.resize(room, (96, 54), interpolation=cv2.INTER_AREA)
    close = np.ascontiguousarray(room[20:74, 60:156])
    assert cuts([wide] * 10 + [close] * 10) == [10]


@pytest.mark.parametrize("step", [2, 5, 9, 14])
def test_pan_is_no_cut_even_when_it_starts_and_stops_suddenly(step: int) -> None:
    moved = scene(24, 7, step)
    assert cuts([moved[0]] * 12 + moved + [moved[-1]] * 12) == []


@pytest.mark.parametrize("length", [1, 2, 3])
@pytest.mark.parametrize("level", [0, 255])
def test_flash_and_dropout_are_no_cuts(length: int, level: int) -> None:
    pictures = scene(40, 5)
    for i in range(15, 15 + length):
        pictures[i] = np.clip(0.15 * pictures[i] + 0.85 * level, 0, 255).astype(np.uint8)
    assert cuts(pictures) == []


def test_slow_change_of_light_is_no_cut() -> None:
    gains = np.linspace(1, 0.3, 40)
    assert cuts([(image * gain).astype(np.uint8) for image, gain in zip(scene(40, 2), gains, strict=True)]) == []


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_few_pictures_of_one_scene_have_no_cut(count: int) -> None:
    assert cuts(scene(count, 0)) == []


def test_flat_noisy_pictures_have_no_cut() -> None:
    rng = np.random.default_rng(0)
    assert cuts([rng.integers(118, 123, (54, 96, 3), dtype=np.uint8) for _ in range(30)]) == []


def test_change_of_noise_on_a_flat_picture_is_no_cut() -> None:
    first, second = (np.random.default_rng(seed).integers(119, 122, (54, 96, 3), dtype=np.uint8) for seed in (0, 1))
    assert cuts([first] * 10 + [second] * 10) == []


def test_cut_from_black_is_found() -> None:
    assert cuts([np.zeros((54, 96, 3), np.uint8)] * 10 + scene(10, 0)) == [10]


def test_shots_of_kept_frames_have_no_gaps_and_change_at_the_cut(tmp_path: Path) -> None:
    pictures = [*scene(20, 0), *scene(10, 1), *scene(20, 2)]
    path = encode(tmp_path / "cuts.mp4", pictures)
    whole = ingest(path)
    assert whole.shot.tolist() == [0] * 20 + [1] * 10 + [2] * 20
    thin = ingest(path, IngestConfig(stride=3))
    assert np.array_equal(thin.shot, whole.shot[thin.index])
    tail = ingest(path, IngestConfig(start_s=25 / 25))
    assert tail.shot.tolist() == [0] * 5 + [1] * 20


def test_steady_clip_is_one_shot(tmp_path: Path) -> None:
    assert set(ingest(encode(tmp_path / "clip.mp4", moving(30))).shot) == {0}
    assert set(ingest(encode(tmp_path / "still.mp4", [picture(48, 64)] * 30)).shot) == {0}


@pytest.mark.shared
@pytest.mark.parametrize(
    "name", ["videos/juggle.mp4", "videos/squats.mp4", "captures/a/front.mp4", "captures/b/front.mp4"]
)
def test_real_clips_of_one_take_are_one_shot(shared_dir: Path, name: str) -> None:
    result = ingest(shared_dir / name, IngestConfig(max_size=96))
    assert set(result.shot) == {0}


@pytest.mark.shared
def test_two_real_clips_in_a_row_are_two_shots(shared_dir: Path) -> None:
    names = ("videos/squats.mp4", "videos/juggle.mp4")
    parts = [ingest(shared_dir / name, IngestConfig(max_size=96, max_frames=40)).frames for name in names]
    pictures = [cv2.resize(image, (96, 96)) for part in parts for image in part]
    assert cuts(pictures) == [len(parts[0])]
