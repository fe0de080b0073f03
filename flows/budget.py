"""`ahoy run --budget`: knobs that buy the most accuracy within a time, out of the measured set.

The choice depends on how fast the machine is just then, so it is written down beside the results: the same command
finds it there, and with it everything that was made.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from ahoy_core.cost.choose import Alternative, Choice, choose
from ahoy_core.cost.pace import measure_pace
from flows.pipeline import Call, call_directly
from flows.request import VideoRequest
from flows.steering import STEPS, Course, Steering, overrides_of
from tasks.cost.errors import psnr
from tasks.cost.measured import MeasuredSet, packaged_set
from tasks.cost.predict import LEAST_GAIN_DB, Clip, Predictor, gains_of
from tasks.settings import Preset

FILE = "budget.json"
_SHOWN = 3


@dataclass(frozen=True)
class Budget:
    """What was chosen for a video, and why.

    Attributes:
        overrides: knobs of the run, those that the user fixed last.
        preset: that they change.
        seconds: predicted, wall clock.
        said: lines for a person.
    """

    overrides: tuple[str, ...]
    preset: Preset
    seconds: float
    said: tuple[str, ...]


@dataclass(frozen=True)
class Found:
    """One preset with the knobs that a budget buys round it."""

    preset: Preset
    over_base: float
    choice: Choice
    predictor: Predictor

    @property
    def worth(self) -> tuple[bool, float, float]:
        """What fits first, then what gains most, then the cheapest; of what does not fit the cheapest."""
        if not self.choice.fits:
            return False, -self.choice.seconds, 0.0
        return True, self.over_base + self.choice.gain, -self.choice.seconds


def budgeted(
    request: VideoRequest,
    budget_s: float,
    measured: MeasuredSet | None = None,
    told: Callable[[str], None] = lambda line: None,
) -> tuple[Budget, Call]:
    """Choose the knobs of a request.

    Args:
        request: with a folder or a store; its overrides are kept, their knobs are not chosen.
        budget_s: seconds of wall clock, from now to the report.
        measured: what is known of cost and gain; the packaged set by default.
        told: called with a line on each change of course.

    Returns:
        The choice, and how to call the stages: with what is left to choose chosen anew on the way, unless an earlier
        choice for the same request was found and is taken again as it ended.

    Raises:
        BadInputError: the video cannot be had.
        ValueError: there is no measured set to choose from.
    """
    started = time.perf_counter()
    measured = measured or packaged_set()
    if not measured.gains():
        raise ValueError(
            "expected whole runs in the measured set, got none: `ahoy cost end-to-end --measured FILE` measures them; "
            "until then choose a preset"
        )
    source = request.source()
    folder = Path(request.out) / request.id_of(source) if request.out else None
    asked = {"budget_s": budget_s, "fixed": list(request.overrides), "unit_cpu_s": measured.unit_cpu_s}
    if folder and (before := _read(folder / FILE)) and before["asked"] == asked:
        chosen = before["choice"]
        said = (f"the knobs chosen before for this budget are taken again ({folder / FILE})", *chosen["said"])
        return Budget(tuple(chosen["overrides"]), chosen["preset"], chosen["seconds"], said), call_directly
    fixed = [text.partition("=")[0].strip() for text in request.overrides]
    # A run's stages are measured in CPU seconds of one thread; what they take here is what the unit takes here.
    factor = measure_pace().wall_s / measured.unit_cpu_s
    clip = Clip.of(source.path)
    bought = [_round(preset, request, fixed, measured, clip, factor, budget_s) for preset in measured.rounds()]
    best = max(bought, key=lambda one: one.worth)

    def overrides(changes: Mapping[str, Any]) -> tuple[str, ...]:
        return (*measured.overrides, *overrides_of(changes), *request.overrides)

    said = tuple(_said(best, measured, budget_s, factor))
    budget = Budget(overrides(best.choice.changes), best.preset, best.choice.seconds, said)
    _write(folder, asked, budget)

    def steered(changes: Mapping[str, Any], lines: Sequence[str]) -> None:
        told(lines[-1])
        _write(folder, asked, replace(budget, overrides=overrides(changes), said=(*said, *lines)))

    course = Course(gains_of(measured, fixed, best.preset), best.predictor, started, budget_s, measured.unit_cpu_s)
    return budget, Steering(course, best.choice.changes, steered)


def _round(
    preset: Preset,
    request: VideoRequest,
    fixed: Sequence[str],
    measured: MeasuredSet,
    clip: Clip,
    factor: float,
    budget_s: float,
) -> Found:
    """What the budget buys round one preset."""
    overrides = (*measured.overrides, *request.overrides)
    settings = request.model_copy(update={"preset": preset, "overrides": overrides}).settings()
    predictor = Predictor(measured, settings, clip, factor)
    choice = choose(gains_of(measured, fixed, preset), predictor.seconds, budget_s, STEPS)
    return Found(preset, measured.rounds()[preset], choice, predictor)


def _read(path: Path) -> dict[str, Any] | None:
    try:
        said: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, json.JSONDecodeError):
        return None
    return said if {"asked", "choice"} <= set(said) else None


def _write(folder: Path | None, asked: Mapping[str, Any], budget: Budget) -> None:
    if folder:
        folder.mkdir(parents=True, exist_ok=True)
        text = json.dumps({"asked": asked, "choice": asdict(budget)}, indent=1)
        (folder / FILE).write_text(text, encoding="utf-8")


def _said(found: Found, measured: MeasuredSet, budget_s: float, factor: float) -> list[str]:
    choice, stages = found.choice, found.predictor.by_stage(found.choice.changes)
    lines = [f"budget {_time(budget_s)}: preset {found.preset}" + _changes(choice)]
    dear = sorted(stages, key=lambda name: -stages[name])[:_SHOWN]
    lines.append(
        f"predicted {_time(choice.seconds)} ({', '.join(f'{name} {_time(stages[name])}' for name in dear)}, ...): this "
        f"machine takes {factor:.2f} s now for a CPU second of the measured set's"
    )
    row = measured.whole_row("preset", measured.preset)
    if row is not None:
        known = psnr(row.errors["rmse"])
        lines.append(
            f"predicted gain on the captures that were measured: {found.over_base + choice.gain:+.2f} dB, sharpness "
            f"counted, over preset {measured.preset} ({known:.2f} dB, "
            f"{(row.cpu_s.median if row.cpu_s else 0) / 60:.1f} CPU minutes)"
        )
    if not choice.fits:
        lines.append("that is over the budget: nothing that was measured is cheaper")
    lines += _beyond([one for one in choice.beyond if one.gain > LEAST_GAIN_DB])
    return lines


def _changes(choice: Choice) -> str:
    return "".join(f", {knob}={value}" for knob, value in choice.changes.items()) or ", unchanged"


def _beyond(found: Sequence[Alternative]) -> list[str]:
    if not found:
        return ["more time buys nothing that was measured"]
    return [
        f"more would buy: {one.knob} {one.before} -> {one.value}: {one.gain:+.2f} dB for {_time(one.seconds)}"
        for one in found[:_SHOWN]
    ]


def _time(seconds: float) -> str:
    return f"{seconds:.0f} s" if abs(seconds) < 90 else f"{seconds / 60:.1f} min"
