"""Keeps a run within its budget: before each training, what is left to choose is chosen anew from the time left.

A forecast of minutes from a few seconds of a shared machine is wrong by a third. What the stages so far have taken is
known, and how fast the machine trains is known best from a training.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from ahoy_core.cost.choose import Gains, choose
from ahoy_core.cost.pace import measure_pace
from flows.pipeline import call_directly
from tasks.cost.predict import Predictor
from tasks.settings import Settings
from tasks.stage import Run, Source, Stage, StageRef
from tasks.stages import STAGES

STEPS: Final = ("avatar.steps", "coarse.steps")
TRAININGS: Final = ("coarse", "avatar")
_PACE_S = 1.5  # spent on measuring the pace before the first training


@dataclass(frozen=True)
class Course:
    """What a choice is made from.

    Attributes:
        gains: of the knobs that may be chosen, round the preset of the run.
        predictor: of its seconds.
        started: `time.perf_counter()` when the budget began to run.
        budget_s: seconds.
        unit_cpu_s: of the set's machine (`ahoy_core.cost.pace`).
    """

    gains: Gains
    predictor: Predictor
    started: float
    budget_s: float
    unit_cpu_s: float


def overrides_of(changes: Mapping[str, Any]) -> tuple[str, ...]:
    """Knob -> value as a request states them."""
    return tuple(f"{knob}={json.dumps(value)}" for knob, value in changes.items())


class Steering:
    """Calls the stages of one run, as `flows.pipeline.call_directly` does.

    Args:
        course: what choices are made from.
        changes: knob -> value, as chosen before the run.
        kept: called with all changes and with a line on each that was made on the way, whenever one is made.
    """

    def __init__(
        self, course: Course, changes: Mapping[str, Any], kept: Callable[[Mapping[str, Any], Sequence[str]], None]
    ) -> None:
        self._course, self._changes, self._kept = course, dict(changes), kept
        self._lines: list[str] = []
        self._trained: float | None = None

    def __call__(self, stage: Stage, settings: Settings, inputs: Mapping[str, StageRef | Source], run: Run) -> StageRef:
        """Run a stage with the knobs as they are chosen by then."""
        if stage.name in TRAININGS:
            self._choose(stage.name)
        chosen = self._course.gains.by_knob
        values = {knob: self._changes.get(knob, self._course.gains.base[knob]) for knob in chosen}
        ref = call_directly(stage, settings.with_overrides(overrides_of(values)), inputs, run)
        if stage.name in TRAININGS and ref.state != "cached":
            known = self._course.predictor.at(1.0).by_stage(self._changes).get(stage.name)
            self._trained = ref.bill.wall_s / known if known else None
        return ref

    def _choose(self, stage: str) -> None:
        """Choose the knobs of this stage and of later ones for the time that is left."""
        names = [one.name for one in STAGES]
        left = names[names.index(stage) :]
        gains = self._course.gains
        open_knobs = [knob for knob in gains.by_knob if knob.partition(".")[0] in left]
        decided = {knob: value for knob, value in self._changes.items() if knob not in open_knobs}
        factor = self._trained or measure_pace(_PACE_S).wall_s / self._course.unit_cpu_s
        predictor = self._course.predictor.at(factor)
        spent = time.perf_counter() - self._course.started

        def seconds(changes: Mapping[str, Any]) -> float:
            by_stage = predictor.by_stage({**decided, **changes})
            return spent + sum(took for name, took in by_stage.items() if name in left)

        rest = Gains({k: gains.by_knob[k] for k in open_knobs}, {k: gains.base[k] for k in open_knobs})
        now = {**decided, **choose(rest, seconds, self._course.budget_s, STEPS).changes}
        if now == self._changes:
            return
        moved = [knob for knob in open_knobs if now.get(knob) != self._changes.get(knob)]
        said = ", ".join(
            f"{knob} {self._changes.get(knob, gains.base[knob])} -> {now.get(knob, gains.base[knob])}" for knob in moved
        )
        self._lines.append(
            f"{spent:.0f} s spent before {stage}, {factor:.2f} s here for a CPU second of the measured set's: {said}"
        )
        self._changes = now
        self._kept(now, self._lines)
