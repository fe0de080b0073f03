"""The commands of batches where something is missing: every error says what to do, and nothing is lost."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from flows.cli import app
from storage_schema.batches import cancel_batch, list_batches, read_batch
from storage_schema.store import ArtifactStore
from tests.batch.toy import Toy

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(autouse=True)
def no_server(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("PREFECT_API_URL", raising=False)
    monkeypatch.setenv("AHOY_SERVER", str(tmp_path / "nothing"))


@pytest.fixture
def videos(tmp_path: Path) -> Path:
    Toy.make(tmp_path, "one"), Toy.make(tmp_path, "two")
    path = tmp_path / "videos.txt"
    path.write_text("one.mp4\n# a comment\n\nmissing.mp4\ntwo.mp4\none.mp4\n")
    return path


def _ahoy(*words: str | Path) -> Result:
    return CliRunner().invoke(app, [str(word) for word in words])


def test_without_a_server_the_batch_is_recorded_and_the_way_on_is_said(videos: Path, tmp_path: Path) -> None:
    first = _ahoy("submit", videos, "--store", tmp_path / "store")
    assert first.exit_code == 4 and "ahoy server" in first.output and "the batch is recorded" in first.output.lower()
    again = _ahoy("submit", videos, "--store", tmp_path / "store")
    assert "submitted before" in again.output and len(list_batches(ArtifactStore(tmp_path / "store"))) == 1


def test_bad_lines_are_named_and_the_good_ones_go_in(videos: Path, tmp_path: Path) -> None:
    result = _ahoy("submit", videos, "--store", tmp_path / "store", "--batch", "b")
    assert "line 4: missing.mp4" in result.output and "line 6" in result.output
    assert [e.line for e in read_batch(ArtifactStore(tmp_path / "store"), "b").entries] == [1, 5]


def test_a_knob_that_does_not_exist_is_refused_before_anything_is_written(videos: Path, tmp_path: Path) -> None:
    result = _ahoy("submit", videos, "--store", tmp_path / "store", "--set", "coarse.stepz=3")
    assert result.exit_code == 2 and "coarse.steps" in result.output and not (tmp_path / "store").exists()


def test_the_name_follows_the_content_and_the_settings(videos: Path, tmp_path: Path) -> None:
    store = tmp_path / "store"
    _ahoy("submit", videos, "--store", store)
    other = tmp_path / "videos.csv"
    other.write_text("source,subject\none.mp4,\ntwo.mp4,1\n")
    _ahoy("submit", other, "--store", store)
    _ahoy("submit", videos, "--store", store, "--preset", "draft")
    names = list_batches(ArtifactStore(store))
    assert len(names) == 3 and all(name.startswith("videos-") for name in names)


def test_another_list_under_a_taken_name_is_refused_with_what_differs(videos: Path, tmp_path: Path) -> None:
    _ahoy("submit", videos, "--store", tmp_path / "store", "--batch", "b")
    videos.write_text("one.mp4\n")
    result = _ahoy("submit", videos, "--store", tmp_path / "store", "--batch", "b")
    assert result.exit_code == 2 and "missing here: two" in result.output


def test_status_works_without_a_server(videos: Path, tmp_path: Path) -> None:
    _ahoy("submit", videos, "--store", tmp_path / "store", "--batch", "b")
    result = _ahoy("status", "b", "--store", tmp_path / "store")
    assert result.exit_code == 0 and "2 waiting" in result.output


def test_a_cancelled_batch_is_not_fed_by_a_submit(videos: Path, tmp_path: Path) -> None:
    store = tmp_path / "store"
    _ahoy("submit", videos, "--store", store, "--batch", "b")
    cancel_batch(ArtifactStore(store), "b")
    result = _ahoy("submit", videos, "--store", store, "--batch", "b")
    assert result.exit_code == 0 and "ahoy rerun b" in result.output


@pytest.mark.parametrize("command", ["status", "rerun", "cancel", "logs"])
def test_an_unknown_batch_is_refused(command: str, tmp_path: Path) -> None:
    result = _ahoy(command, "nothing", "--store", tmp_path / "store")
    assert result.exit_code in (2, 4) and "error:" in result.output and "Traceback" not in result.output


def test_a_worker_without_a_server_says_how_to_start_one() -> None:
    result = _ahoy("worker")
    assert result.exit_code == 4 and "ahoy server" in result.output


def test_status_imports_neither_the_science_nor_the_orchestrator(videos: Path, tmp_path: Path) -> None:
    """They take ten seconds, and status is asked for often."""
    _ahoy("submit", videos, "--store", tmp_path / "store", "--batch", "b")
    code = (
        "import sys; from typer.testing import CliRunner; from flows.cli import app;"
        "done = CliRunner().invoke(app, ['status', 'b', '--store', sys.argv[1]]);"
        "print(done.exit_code, [name for name in ('torch', 'prefect', 'numba') if name in sys.modules])"
    )
    command = [sys.executable, "-c", code, str(tmp_path / "store")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "0 []", done.stdout + done.stderr
