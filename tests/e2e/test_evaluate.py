"""`ahoy evaluate` on the bundled clip as a plain video: real stages, few steps."""

from __future__ import annotations

import re

import pyarrow.parquet as pq
import pytest
from typer.testing import Result

from ahoy_core.formats.npz import load_npz
from storage_schema.store import ArtifactStore
from storage_schema.tables import Tables
from tests.e2e.conftest import SmallRun, ahoy, small_options


def _evaluate(run: SmallRun, *more: str) -> Result:
    return ahoy(
        "evaluate", str(run.clip), "--out", str(run.out / "scores"), "--store", str(run.out / "store"),
        "--ablate", "full,A", "--withhold", "2", *small_options(), *more,
    )  # fmt: skip


@pytest.fixture(scope="module")
def evaluated(small_run: SmallRun) -> Result:
    result = _evaluate(small_run)
    assert result.exit_code == 0, result.output
    return result


def test_a_plain_video_is_scored_on_frames_that_no_stage_but_perception_used(
    evaluated: Result, small_run: SmallRun
) -> None:
    rows = pq.read_table(small_run.out / "scores" / "metrics.parquet").to_pylist()
    held = {row["frame"] for row in rows if row["protocol"] == "held-out-frame"}
    store = ArtifactStore(small_run.out / "store")
    stages = Tables(store).read("stages", "evaluate").to_pylist()
    key = next(row["key"] for row in stages if row["stage"] == "withhold")
    manifest = store.lookup(key, stage="withhold")
    assert manifest is not None
    used = load_npz(store.fetch(manifest) / "body.npz", ["used"])["used"]
    assert len(held) == 3 and used.sum() == 3
    assert {row["config"] for row in rows} == {
        "full", "A", "reference: shifted 2 px", "reference: flat colour",
    }  # fmt: skip
    assert all(5 < row["psnr"] < 60 for row in rows if row["region"] == "box")


def test_the_folder_holds_table_pictures_and_chart(evaluated: Result, small_run: SmallRun) -> None:
    out = small_run.out / "scores"
    text = (out / "table.md").read_text()
    assert "No video prior" in text and "## held-out-frame" in text and "novel-view-gt left out" in text
    assert len(list((out / "pictures" / small_run.clip.stem / "full").glob("held-out-frame_*.png"))) == 3
    assert (out / "chart.png").is_file() and "No video prior" in evaluated.output


def test_a_second_run_makes_nothing_again(evaluated: Result, small_run: SmallRun) -> None:
    again = _evaluate(small_run)
    assert again.exit_code == 0, again.output
    assert len(re.findall("evaluate +found in the store", again.output)) == 4 and " s CPU" not in again.output


def test_what_is_not_a_data_set_or_a_configuration_is_refused(evaluated: Result, small_run: SmallRun) -> None:
    for options, expected in (
        (("--ablate", "full,Z"), "full, A, B1"),
        (("--protocols", "best"), "novel-view-gt"),
        (("--only", "nobody"), "captures among"),
    ):
        result = _evaluate(small_run, *options)
        assert result.exit_code == 2 and expected in result.output.replace("\n", " "), result.output
