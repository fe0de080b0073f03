"""The regression guard: what is worse is flagged, what is noise is not."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import pytest

from ahoy_core.cost import Measurement, Spread
from benchmarks.compare import main


def _file(path: Path, *rows: dict) -> str:
    path.write_text("".join(json.dumps(row) + "\n" for row in rows), encoding="utf-8")
    return str(path)


def _swept(value: int, rmse: float, cpu: tuple[float, float, float], **more: object) -> dict:
    wall = Spread(cpu[0] * 3, cpu[1], cpu[2] * 9, 3)
    row = Measurement("coarse.steps", {"steps": value}, {"rmse": rmse}, wall, Spread(*cpu, 3), capture="a", **more)  # type: ignore[arg-type]
    return dataclasses.asdict(row)


def _run(tmp_path: Path, old: list[dict], new: list[dict], *options: str) -> int:
    return main([_file(tmp_path / "old", *old), _file(tmp_path / "new", *new), *options])


BASE = (_swept(30, 20.0, (3.0, 2.9, 3.1)), _swept(60, 18.0, (6.0, 5.8, 6.2)))


def test_equal_files_and_noise_pass(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    noisy = [_swept(30, 20.1, (3.2, 3.0, 3.4)), _swept(60, 18.0, (7.0, 6.1, 8.0))]  # 17% slower, but ranges overlap
    assert _run(tmp_path, list(BASE), noisy) == 0
    assert "2 rows compared, 0 figures worse" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("row", "figure"),
    [
        (_swept(60, 18.0, (7.5, 7.2, 7.9)), "cpu_s"),
        (_swept(60, 18.6, (6.0, 5.8, 6.2)), "errors.rmse"),
        ({**_swept(60, 18.0, (6.0, 5.8, 6.2)), "cpu_s": None, "errors": {}, "failed": "ValueError: no"}, "row"),
    ],
)
def test_slower_less_accurate_and_failing_rows_are_flagged(
    tmp_path: Path, row: dict, figure: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _run(tmp_path, list(BASE), [BASE[0], row]) == 1
    (line,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("WORSE")]
    assert f"{figure}:" in line and "setting.steps=60" in line


def test_wall_time_counts_only_if_asked(tmp_path: Path) -> None:
    slow = {**BASE[1], "wall_s": {"median": 99.0, "low": 98.0, "high": 100.0, "repeats": 3}}
    assert _run(tmp_path, list(BASE), [BASE[0], slow]) == 0
    assert _run(tmp_path, list(BASE), [BASE[0], slow], "--wall") == 1


def test_better_is_said_and_passes_and_gone_rows_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert _run(tmp_path, list(BASE), [_swept(30, 15.0, (1.0, 0.9, 1.1))]) == 0
    said = capsys.readouterr().out
    assert said.count("better") == 2 and "gone" in said


def test_lines_of_other_benchmarks_are_understood(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    machine = {"machine": {"cpu": "x"}, "threads": 1}
    line = {"capture": "a", "config": "full", "psnr_novel_view": 22.0, "cpu_seconds": 50.0, "steps": 60, "notes": ["x"]}
    speed = {"kind": "speed", "scene": "10k", "peer": "ahoy", "cpu_ms": {"median": 10, "low": 9.9, "high": 10.1}}
    worse = {**line, "psnr_novel_view": 21.5, "notes": []}
    slower = {**speed, "cpu_ms": {"median": 12, "low": 11.9, "high": 12.1}}
    assert _run(tmp_path, [machine, line, speed], [machine, worse, slower]) == 1
    said = capsys.readouterr().out
    assert said.count("WORSE") == 2 and "psnr_novel_view: 22 -> 21.5" in said and "2 rows compared" in said
    assert _run(tmp_path, [line], [{**line, "steps": 30, "psnr_novel_view": 1.0}]) == 0  # another setting


def test_what_is_no_json_lines_is_refused(tmp_path: Path) -> None:
    (tmp_path / "x").write_text("hello")
    with pytest.raises(SystemExit):
        main([str(tmp_path / "x"), str(tmp_path / "x")])
