"""Which frames are kept."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from ahoy_core.formats.errors import EmptySelectionError
from ahoy_core.ingest import IngestConfig, ingest
from ahoy_core.ingest.run import select

from .clips import encode, moving


@given(st.integers(1, 400), st.integers(1, 7), st.integers(1, 90))
def test_thinning_is_even_and_never_exceeds_the_limit(count: int, stride: int, limit: int) -> None:
    pts = np.arange(count) / 25
    inside, chosen = select(pts, IngestConfig(stride=stride, max_frames=limit))
    assert len(inside) == count
    assert len(chosen) == min(limit, -(-count // stride))
    available = -(-count // stride)
    assert chosen[0] == 0
    assert available - chosen[-1] // stride <= -(-available // len(chosen))
    gaps = np.diff(chosen) // stride
    assert np.all(np.diff(chosen) % stride == 0)
    assert len(gaps) == 0 or gaps.max() - gaps.min() <= 1


@given(st.floats(0, 3), st.floats(0.01, 3))
def test_time_range_is_half_open(start: float, length: float) -> None:
    pts = np.sort(np.random.default_rng(0).uniform(0, 4, 50))
    inside, chosen = select(pts, IngestConfig(start_s=start, end_s=start + length, max_frames=None))
    assert np.array_equal(inside, chosen)
    kept = np.zeros(50, bool)
    kept[inside] = True
    assert np.array_equal(kept, (pts >= start) & (pts < start + length))


def test_selected_frames_are_the_same_pictures_as_without_selection(tmp_path: Path) -> None:
    path = encode(tmp_path / "clip.mp4", moving(50))
    everything = ingest(path)
    part = ingest(path, IngestConfig(start_s=0.4, end_s=1.6, stride=2, max_frames=10))
    assert part.index[0] == 10 and part.index[-1] < 40 and len(part.index) == 10
    assert np.array_equal(part.frames, everything.frames[part.index])
    assert np.array_equal(part.pts, everything.pts[part.index])
    assert any("30 of 50" in note for note in part.notes)
    assert any("thinned evenly to 10" in note for note in part.notes)


@pytest.mark.parametrize("container", ["mp4", "mkv", "ts"])
def test_a_time_span_is_kept_exactly_by_the_frames_own_times(tmp_path: Path, container: str) -> None:
    """Uneven times, spans that begin and end on a frame: the first is in, the last is out, by exact comparison."""
    times = [0, 40, 90, 100, 270, 300, 333, 400, 480, 555]
    whole = ingest(encode(tmp_path / f"clip.{container}", moving(len(times)), times=times))
    pts = whole.pts.tolist()
    assert len(pts) == len(times) and np.allclose(pts, np.array(times) / 1000, atol=2e-3)
    for first, last in ((0, 10), (1, 4), (4, 5), (3, 9), (9, 10)):
        end = pts[last] if last < len(pts) else None
        part = ingest(tmp_path / f"clip.{container}", IngestConfig(start_s=pts[first], end_s=end))
        assert part.index.tolist() == list(range(first, last))
        assert part.pts.tolist() == pts[first:last]
        assert np.array_equal(part.frames, whole.frames[first:last])


def test_empty_range_says_how_long_the_video_is(tmp_path: Path) -> None:
    path = encode(tmp_path / "clip.mp4", moving(25))
    with pytest.raises(EmptySelectionError, match=r"lasts 1\.00 s"):
        ingest(path, IngestConfig(start_s=7))


def test_progress_rises_to_the_end(tmp_path: Path) -> None:
    calls: list[tuple[int, int]] = []
    ingest(encode(tmp_path / "clip.mp4", moving(12)), progress=lambda done, total: calls.append((done, total)))
    assert calls == [(i, 12) for i in range(1, 13)]


@pytest.mark.parametrize(
    "wrong", [{"max_size": 0}, {"stride": 0}, {"max_frames": 0}, {"start_s": 2, "end_s": 1}, {"size": 3}]
)
def test_impossible_configurations_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValidationError):
        IngestConfig(**wrong)


def test_artifact_arrays_have_the_declared_types(tmp_path: Path) -> None:
    from storage_schema.artifacts import ARTIFACTS

    arrays = ingest(encode(tmp_path / "clip.mp4", moving(5))).arrays()
    declared = ARTIFACTS["ingest"][0].arrays
    assert set(arrays) == set(declared)
    assert all(arrays[name].dtype == declared[name].dtype for name in declared)
    assert all(arrays[name].ndim == len(declared[name].shape) for name in declared)
