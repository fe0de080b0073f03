"""`ahoy run --budget`: the choice for a real clip from a made-up measured set, said, kept and taken again."""

from __future__ import annotations

from dataclasses import replace
from importlib import resources
from pathlib import Path

import pytest
from typer.testing import CliRunner

import flows.budget as budget_module
from ahoy_core.cost import Measurement, Spread
from ahoy_core.cost.pace import Pace
from ahoy_core.cost.work import FRAMES, PIXELS
from flows.budget import FILE, budgeted
from flows.cli import app
from flows.duration import seconds_of
from flows.request import VideoRequest
from tasks.cost.errors import rmse
from tasks.cost.measured import MeasuredSet, cited
from tasks.cost.predict import work_knobs
from tasks.presets import PRESETS

CLIP = str(resources.files("ahoy_core.assets").joinpath("demo.mp4"))


def _row(knob: str, value: object, db: float, seconds: float) -> Measurement:
    took = Spread(seconds, seconds, seconds, 1)
    knobs = work_knobs(PRESETS["draft"], {FRAMES: 48, PIXELS: 65_536}) | {knob: value}
    return Measurement(f"end-to-end.{knob}", {knob: value}, {"rmse": rmse(db)}, took, took, capture="a", knobs=knobs,
                       parts={"avatar": seconds})  # fmt: skip


@pytest.fixture
def measured() -> MeasuredSet:
    base = PRESETS["draft"].avatar.steps
    rows = (
        _row("preset", "draft", 20.0, 20.0 + base),
        *(_row("avatar.steps", steps, db, 20.0 + steps) for steps, db in ((30, 19.0), (240, 20.6))),
    )
    return MeasuredSet(rows, 0.05, {"cpu": "x"}, "draft", ())


@pytest.fixture(autouse=True)
def pace(monkeypatch: pytest.MonkeyPatch) -> list[Pace]:
    """A machine as fast as the set's, until told otherwise."""
    now = [Pace(0.05, 0.05)]
    monkeypatch.setattr(budget_module, "measure_pace", lambda: now[0])
    return now


def _steps(overrides: tuple[str, ...]) -> int:
    return VideoRequest(video=CLIP, store="x", preset="draft", overrides=overrides).settings().avatar.steps


def test_more_time_buys_more_steps_and_the_prediction_is_within_the_budget(
    measured: MeasuredSet, tmp_path: Path
) -> None:
    request = VideoRequest(video=CLIP, store=str(tmp_path / "store"))
    found = [budgeted(request, seconds, measured) for seconds in (80.0, 150.0, 300.0)]
    steps = [_steps(one.overrides) for one in found]
    assert steps == sorted(steps) and steps[0] < PRESETS["draft"].avatar.steps < steps[2] == 240
    assert all(one.seconds <= limit for one, limit in zip(found, (80.0, 150.0, 300.0), strict=True))
    assert any("+0." in line or "-0." in line for line in found[0].said) and "more would buy" in " ".join(found[0].said)
    assert "more time buys nothing" in " ".join(found[2].said)


def test_a_slow_machine_gets_fewer_steps_and_an_impossible_budget_is_said(
    measured: MeasuredSet, tmp_path: Path, pace: list[Pace]
) -> None:
    request = VideoRequest(video=CLIP, store=str(tmp_path / "store"))
    quick = budgeted(request, 150.0, measured)
    pace[0] = Pace(0.1, 0.1)
    slow = budgeted(request, 150.0, measured)
    assert _steps(slow.overrides) < _steps(quick.overrides)
    assert "over the budget" in " ".join(budgeted(request, 5.0, measured).said)


def test_the_choice_is_kept_beside_the_results_and_taken_again(
    measured: MeasuredSet, tmp_path: Path, pace: list[Pace]
) -> None:
    request = VideoRequest(video=CLIP, out=str(tmp_path))
    first = budgeted(request, 150.0, measured)
    assert len(list(tmp_path.glob(f"*/{FILE}"))) == 1
    pace[0] = Pace(0.2, 0.2)
    again = budgeted(request, 150.0, measured)
    assert again.found and again.overrides == first.overrides
    assert not budgeted(request, 200.0, measured).found  # another budget


def test_a_knob_that_the_user_fixed_is_not_chosen(measured: MeasuredSet, tmp_path: Path) -> None:
    request = VideoRequest(video=CLIP, store=str(tmp_path), overrides=("avatar.steps=33",))
    assert _steps(budgeted(request, 500.0, measured).overrides) == 33


def test_without_whole_runs_there_is_nothing_to_choose_from(measured: MeasuredSet, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="ahoy cost end-to-end"):
        budgeted(VideoRequest(video=CLIP, store=str(tmp_path)), 60.0, replace(measured, rows=()))


def test_presets_cite_their_row(measured: MeasuredSet) -> None:
    assert "20.00 dB" in cited("draft", measured) and "no whole run" in cited("high", measured)


def test_durations_and_contradictions_are_said() -> None:
    assert (seconds_of("90s", "3m"), seconds_of("3m", "3m"), seconds_of("1.5h", "3m")) == (90.0, 180.0, 5400.0)
    for options, expected in (
        (("--budget", "soon"), "such as 3m"),
        (("--budget", "3m", "--preset", "draft"), "--preset or --budget"),
    ):
        result = CliRunner().invoke(app, ["run", CLIP, "--out", "unused", *options])
        assert result.exit_code == 2 and expected in result.output.replace("\n", " "), result.output
