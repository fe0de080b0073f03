"""What an evaluation says: tables by protocol id, remarks, the chart."""

from __future__ import annotations

from pathlib import Path

import pytest

from storage_schema.store import ArtifactStore
from tasks.evaluation.pictures import draw_chart
from tasks.evaluation.results import Cell, read_metrics, remarks, write_results
from tasks.evaluation.tables import differences, one_table, tables
from tasks.stage import Bill, StageRef

REF = StageRef("evaluate", "k", "h", "done", Bill())


def _row(capture: str, config: str, psnr: float, identity: str = "novel-view-gt/region=box/size=256x256") -> dict:
    return {
        "capture": capture, "config": config, "protocol": "novel-view-gt", "region": "box", "camera": "left",
        "frame": 0, "psnr": psnr, "ssim": 0.9, "perceptual": 0.1, "perceptual_name": "net", "iou": 0.8,
        "protocol_id": identity, "input_setting": "video",
    }  # fmt: skip


def _rows(captures: int = 2) -> list[dict]:
    values = {"full": 22.0, "reference: shifted 2 px": 21.0, "C2": 20.5, "reference: flat colour": 18.0}
    return [_row(f"c{n}", name, value + n) for n in range(captures) for name, value in values.items()]


def test_a_table_names_its_protocol_id_and_ends_with_the_references() -> None:
    lines = one_table(_rows()).splitlines()
    assert lines[0] == "`novel-view-gt/region=box/size=256x256`"
    assert lines[2] == "| configuration | input | PSNR | SSIM | net | IoU | PSNR c0 | PSNR c1 |"
    assert [line.split(" | ")[0][2:] for line in lines[4:]] == [
        "full", "C2", "reference: shifted 2 px", "reference: flat colour",
    ]  # fmt: skip
    assert lines[4] == "| full | video | 22.50 | 0.900 | 0.100 | 0.800 | 22.00 | 23.00 |"


def test_rows_of_two_protocol_ids_get_two_tables_and_never_one() -> None:
    rows = [*_rows(1), _row("c9", "full", 30.0, "novel-view-gt/region=box/size=128x256")]
    with pytest.raises(ValueError, match="one protocol id"):
        one_table(rows)
    text = tables(rows)
    assert text.count("### novel-view-gt, box") == 2 and "26.00" not in text


def test_few_captures_are_listed_one_by_one_and_many_get_an_interval() -> None:
    few, many = tables(_rows(2)), tables(_rows(6))
    assert "no interval" in few and "| C2 | -1.50 | -1.50 | -1.50 | 2 |" in few
    assert "bootstrap" in many and "-1.50 to -1.50" in many
    assert [one.config for one in differences(_rows(2))] == ["C2"]  # references are no configurations


def test_the_chart_shows_what_there_is(tmp_path: Path) -> None:
    assert draw_chart(_rows(6), tmp_path / "chart.png") and (tmp_path / "chart.png").stat().st_size > 5000
    assert not draw_chart([], tmp_path / "none.png") and not (tmp_path / "none.png").exists()


def _cell(config: str, avatar: str, prior: bool = False, capture: str = "a") -> Cell:
    return Cell(capture, config, REF, facts={"avatar": avatar, "prior": prior})


def test_it_is_said_that_no_prior_was_used_and_which_avatars_are_the_same() -> None:
    said = "\n".join(remarks([_cell("full", "x"), _cell("B2", "x"), _cell("A", "y"), _cell("A", "x", capture="b")]))
    assert "No video prior" in said and "`A` against `full`" in said
    assert "a: full and B2 are the same avatar, bit for bit." in said and "b:" not in said
    assert remarks([_cell("full", "x", prior=True), _cell("A", "y", prior=True)]) == []


def test_a_cell_that_failed_is_named_with_its_reason() -> None:
    assert remarks([Cell("a", "C1", error="ValueError: no frames")]) == ["- not scored: a, C1: ValueError: no frames"]


def test_rows_of_an_earlier_evaluation_under_another_protocol_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tasks.evaluation.results.read_rows", lambda store, cells: _rows(1))
    store = ArtifactStore(tmp_path / "store")
    other = [_row("c0", "other system", 25.0, "novel-view-gt/region=box/size=512x512")]
    with pytest.raises(ValueError, match="never put into one table"):
        write_results(store, [], {}, tmp_path / "out", [], other)
    paths = write_results(store, [], {}, tmp_path / "out", ["# Title"], [_row("c0", "other system", 25.0)])
    assert read_metrics(paths["metrics.parquet"])[-1]["config"] == "other system"
    with pytest.raises(ValueError, match=r"expected the metrics\.parquet"):
        read_metrics(paths["table.md"])
    assert "| other system | video | 25.00 |" in paths["table.md"].read_text()
