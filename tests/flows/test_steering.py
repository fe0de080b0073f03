"""A budget that is kept on the way: stages that take seconds of a made-up clock, on a machine misjudged at first."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import resources
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import flows.steering as steering_module
from ahoy_core.cost.choose import Gains, choose
from ahoy_core.cost.meter import Bill
from ahoy_core.cost.pace import Pace
from flows.steering import STEPS, Course, Steering
from tasks.cost.measured import packaged_set
from tasks.cost.predict import Clip, Predictor
from tasks.presets import PRESETS
from tasks.settings import Settings
from tasks.stage import StageRef
from tasks.stages import STAGES

CLIP = Clip.of(Path(str(resources.files("ahoy_core.assets").joinpath("demo.mp4"))))
SET = packaged_set()
DRAFT = PRESETS["draft"]
Kept = list[tuple[Mapping[str, Any], list[str]]]


def _gains() -> Gains:
    """Steps that always pay, so that what is left of a budget can be used; doubled like those that are measured."""
    avatar = {15 * 2**k: (k - 3) / 3 for k in range(7)}
    steps = {"avatar.steps": avatar, "coarse.steps": {15: -0.1, 60: 0.0, 240: 0.1}}
    stride = {"texture.frame_stride": {2: 0.0, 1: 0.5}}
    return Gains({**steps, **stride}, {"avatar.steps": 120, "coarse.steps": 60, "texture.frame_stride": 2})


@pytest.fixture
def drive(monkeypatch: pytest.MonkeyPatch) -> Callable[..., tuple[float, dict[str, Settings], Kept]]:
    def run(budget_s: float, believed: float, true: float, cached: tuple[str, ...] = ()) -> Any:
        clock, ran, kept = [100.0], dict[str, Settings](), Kept()
        gains, base = _gains(), Predictor(SET, DRAFT, CLIP, 1.0)

        def call(stage: Any, settings: Settings, inputs: Any, run: Any) -> StageRef:
            changes = {k: getattr(getattr(settings, k.split(".")[0]), k.split(".")[1]) for k in gains.by_knob}
            took = 0.0 if stage.name in cached else true * base.by_stage(changes).get(stage.name, 0.0)
            clock[0] += took
            ran[stage.name] = settings
            return StageRef(stage.name, "k", "h", "cached" if stage.name in cached else "done", Bill(took, took, 1.0))

        monkeypatch.setattr(steering_module, "call_directly", call)
        monkeypatch.setattr(steering_module, "time", SimpleNamespace(perf_counter=lambda: clock[0]))
        pace = Pace(SET.unit_cpu_s, believed * SET.unit_cpu_s)
        monkeypatch.setattr(steering_module, "measure_pace", lambda seconds: pace)
        predictor = base.at(believed)
        choice = choose(gains, predictor.seconds, budget_s, STEPS)
        course = Course(gains, predictor, clock[0], budget_s, SET.unit_cpu_s)
        steering = Steering(course, choice.changes, lambda changes, lines: kept.append((dict(changes), list(lines))))
        for stage in STAGES:
            steering(stage, DRAFT, {}, None)  # type: ignore[arg-type]
        return clock[0] - 100.0, ran, kept

    return run


@pytest.mark.parametrize("budget_s", [120.0, 240.0])
@pytest.mark.parametrize(("believed", "true"), [(2.0, 1.0), (1.0, 2.0), (1.3, 1.3)])
def test_a_run_ends_within_a_fifth_of_its_budget_on_a_machine_twice_or_half_as_fast_as_it_seemed(
    drive: Any, budget_s: float, believed: float, true: float
) -> None:
    took, *_ = drive(budget_s, believed, true)
    assert 0.8 * budget_s <= took <= 1.2 * budget_s
    blind = choose(_gains(), Predictor(SET, DRAFT, CLIP, believed).seconds, budget_s, STEPS).changes
    unsteered = Predictor(SET, DRAFT, CLIP, true).seconds(blind)
    assert believed == true or not 0.8 * budget_s <= unsteered <= 1.2 * budget_s, "else nothing was to be mended"


def test_only_what_has_not_begun_is_chosen_anew_and_every_change_is_kept_and_said(drive: Any) -> None:
    _, ran, kept = drive(200.0, 2.5, 1.0)
    first = choose(_gains(), Predictor(SET, DRAFT, CLIP, 2.5).seconds, 200.0, STEPS).changes
    assert ran["texture"].texture.frame_stride == first.get("texture.frame_stride", 2)
    changes, lines = kept[-1]
    assert ran["avatar"].avatar.steps == changes["avatar.steps"] > first.get("avatar.steps", 120)
    assert ran["coarse"].coarse.steps == changes.get("coarse.steps", 60)
    assert "spent before avatar" in lines[-1] and f"-> {changes['avatar.steps']}" in lines[-1]
    assert ran["animate"].avatar == ran["avatar"].avatar, "later stages are told the same settings"


def test_what_is_found_in_the_store_leaves_its_time_to_the_trainings_and_says_nothing_of_the_pace(drive: Any) -> None:
    found = ("ingest", "perceive", "texture", "complete", "coarse")
    took, ran, _ = drive(150.0, 1.0, 1.0, cached=found)
    assert 0.8 * 150 <= took <= 1.2 * 150
    assert ran["avatar"].avatar.steps > drive(150.0, 1.0, 1.0)[1]["avatar"].avatar.steps


def test_a_run_that_keeps_its_pace_is_left_alone(drive: Any) -> None:
    assert drive(200.0, 1.3, 1.3)[2] == []
