"""Videos that are hardly videos, through the whole job."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from ahoy_core.formats.npz import load_npz
from ahoy_core.formats.video import read_frames, write_mp4
from storage_schema.store import ArtifactStore
from storage_schema.tables import Tables
from tests.e2e.conftest import ahoy, small_options


@pytest.fixture(scope="module")
def people(demo_clip: Path) -> list[np.ndarray]:
    return [frame.image for frame in read_frames(demo_clip)][:6]


def _nobody(like: np.ndarray, seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).integers(0, 24, like.shape, np.uint8)
    return noise + np.uint8(100)


def test_a_video_of_one_frame_becomes_an_avatar(models: None, people: list[np.ndarray], tmp_path: Path) -> None:
    write_mp4(tmp_path / "one.mp4", people[:1], 15)
    result = ahoy("run", str(tmp_path / "one.mp4"), "--out", str(tmp_path / "out"), *small_options())
    assert result.exit_code == 0, result.output
    assert list((tmp_path / "out").glob("one-*/avatar.ply"))


def test_a_video_without_a_person_is_refused_and_filed(models: None, people: list[np.ndarray], tmp_path: Path) -> None:
    write_mp4(tmp_path / "none.mp4", [_nobody(people[0], i) for i in range(4)], 15)
    result = ahoy("run", str(tmp_path / "none.mp4"), "--out", str(tmp_path / "out"), *small_options())
    assert result.exit_code == 2 and "expected a person" in result.output and "Traceback" not in result.output
    rows = Tables(ArtifactStore(tmp_path / "out" / "store")).read("stages").to_pylist()
    assert [(r["stage"], r["error_class"]) for r in rows if r["state"] == "failed"] == [("perceive", "NoPersonError")]


def test_frames_without_the_person_are_left_out_and_named(
    models: None, people: list[np.ndarray], tmp_path: Path
) -> None:
    write_mp4(tmp_path / "some.mp4", [*(_nobody(people[0], i) for i in range(3)), *people[:3]], 15)
    out = tmp_path / "out"
    result = ahoy("run", str(tmp_path / "some.mp4"), "--out", str(out), "--stages", "perceive", *small_options())
    assert result.exit_code == 0, result.output
    used = load_npz(next((out / "store").rglob("body.npz")), ["used"])["used"]
    assert used.tolist() == [False] * 3 + [True] * 3
    notes = json.loads(next((out / "store").rglob("fit.json")).read_text())
    assert notes["frames_without_person"] == [[0, 2]]
