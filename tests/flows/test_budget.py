"""`ahoy run --budget`: the choice for a real clip from a made-up measured set, said, kept and taken again."""

from __future__ import annotations

from dataclasses import replace
from importlib import resources
from pathlib import Path

import pytest
from typer.testing import CliRunner

import flows.budget as budget_module
import flows.steering as steering_module
from ahoy_core.cost import Measurement, Spread
from ahoy_core.cost.pace import Pace
from ahoy_core.cost.work import FRAMES, PIXELS
from flows.budget import FILE, budgeted
from flows.cli import app
from flows.duration import seconds_of
from flows.pipeline import call_directly
from flows.request import VideoRequest
from tasks.cost.change import PRESET, Change
from tasks.cost.errors import rmse
from tasks.cost.measured import MeasuredSet, cited
from tasks.cost.predict import work_knobs
from tasks.presets import PRESETS

CLIP = str(resources.files("ahoy_core.assets").joinpath("demo.mp4"))


def _row(change: Change, db: float, seconds: float, coarse_s: float = 0.0) -> Measurement:
    took = Spread(seconds, seconds, seconds, 1)
    changed = {} if change.knob == PRESET else {change.knob: change.value}
    preset = change.value if change.knob == PRESET else change.preset
    knobs = work_knobs(PRESETS[preset], {FRAMES: 48, PIXELS: 65_536}) | changed
    return Measurement(change.sweep("draft"), change.setting("draft"), {"rmse": rmse(db)}, took, took, capture="a",
                       knobs=knobs, parts={"coarse": coarse_s, "avatar": seconds - coarse_s})  # fmt: skip


@pytest.fixture
def measured() -> MeasuredSet:
    base = PRESETS["draft"].avatar.steps
    rows = (
        _row(Change("draft", PRESET, "draft"), 20.0, 20.0 + base),
        *(_row(Change("draft", "avatar.steps", steps), db, 20.0 + steps) for steps, db in ((30, 19.0), (240, 20.6))),
    )
    return MeasuredSet(rows, 0.05, {"cpu": "x"}, "draft", ())


@pytest.fixture(autouse=True)
def pace(monkeypatch: pytest.MonkeyPatch) -> list[Pace]:
    """A machine as fast as the set's, until told otherwise."""
    now = [Pace(0.05, 0.05)]
    monkeypatch.setattr(budget_module, "measure_pace", lambda: now[0])
    monkeypatch.setattr(steering_module, "measure_pace", lambda seconds: now[0])
    return now


def _steps(overrides: tuple[str, ...]) -> int:
    return VideoRequest(video=CLIP, store="x", preset="draft", overrides=overrides).settings().avatar.steps


def test_more_time_buys_more_steps_and_the_prediction_is_within_the_budget(
    measured: MeasuredSet, tmp_path: Path
) -> None:
    request = VideoRequest(video=CLIP, store=str(tmp_path / "store"))
    found = [budgeted(request, seconds, measured)[0] for seconds in (80.0, 150.0, 300.0)]
    steps = [_steps(one.overrides) for one in found]
    assert steps == sorted(steps) and steps[0] < PRESETS["draft"].avatar.steps < steps[2] == 240
    assert all(one.seconds <= limit for one, limit in zip(found, (80.0, 150.0, 300.0), strict=True))
    assert any("+0." in line or "-0." in line for line in found[0].said) and "more would buy" in " ".join(found[0].said)
    assert "more time buys nothing" in " ".join(found[2].said)


def test_a_slow_machine_gets_fewer_steps_and_an_impossible_budget_is_said(
    measured: MeasuredSet, tmp_path: Path, pace: list[Pace]
) -> None:
    request = VideoRequest(video=CLIP, store=str(tmp_path / "store"))
    quick, _ = budgeted(request, 150.0, measured)
    pace[0] = Pace(0.1, 0.1)
    slow, _ = budgeted(request, 150.0, measured)
    assert _steps(slow.overrides) < _steps(quick.overrides)
    assert "over the budget" in " ".join(budgeted(request, 5.0, measured)[0].said)


def test_the_choice_is_kept_beside_the_results_and_taken_again(
    measured: MeasuredSet, tmp_path: Path, pace: list[Pace]
) -> None:
    request = VideoRequest(video=CLIP, out=str(tmp_path))
    first, steered = budgeted(request, 150.0, measured)
    assert len(list(tmp_path.glob(f"*/{FILE}"))) == 1
    pace[0] = Pace(0.2, 0.2)
    again, call = budgeted(request, 150.0, measured)
    assert again.overrides == first.overrides and "taken again" in again.said[0]
    assert call is call_directly and steered is not call_directly, "what was made is found, not chosen anew"
    assert "taken again" not in budgeted(request, 200.0, measured)[0].said[0]


def test_a_knob_that_the_user_fixed_is_not_chosen(measured: MeasuredSet, tmp_path: Path) -> None:
    request = VideoRequest(video=CLIP, store=str(tmp_path), overrides=("avatar.steps=33",))
    assert _steps(budgeted(request, 500.0, measured)[0].overrides) == 33


def test_without_whole_runs_there_is_nothing_to_choose_from(measured: MeasuredSet, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="ahoy cost end-to-end"):
        budgeted(VideoRequest(video=CLIP, store=str(tmp_path)), 60.0, replace(measured, rows=()))


def test_time_that_no_knob_of_the_base_can_use_buys_another_preset_and_its_knobs(
    measured: MeasuredSet, tmp_path: Path
) -> None:
    steps = PRESETS["standard"].avatar.steps
    richer = replace(measured, rows=(
        *measured.rows,
        _row(Change("draft", PRESET, "standard"), 22.0, 40.0 + 4 * steps),
        _row(Change("standard", "avatar.steps", 240), 22.5, 40.0 + 4 * 240),
        _row(Change("standard", "avatar.steps", 30), 21.0, 40.0 + 4 * 30),
    ))  # fmt: skip
    request = VideoRequest(video=CLIP, store=str(tmp_path / "store"))
    found = {seconds: budgeted(request, seconds, richer)[0] for seconds in (120.0, 500.0, 700.0, 3000.0)}
    assert [one.preset for one in found.values()] == ["draft", "standard", "standard", "standard"]
    assert _steps(found[3000.0].overrides) == 240 and 30 < _steps(found[500.0].overrides) < steps
    assert "+2.50 dB" in " ".join(found[3000.0].said), "the preset's gain and the knob's beside it"
    dear = replace(richer, rows=tuple(row for row in richer.rows if row.setting != {PRESET: "standard"}))
    assert budgeted(request, 3000.0, dear)[0].preset == "draft", "a preset without a row of its own is not chosen"


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
