"""`ahoy run --budget`: knobs that buy the most accuracy within a time, out of the measured set.

The choice depends on how fast the machine is just then, so it is written down beside the results: the same command
finds it there, and with it everything that was made.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ahoy_core.cost.choose import Alternative, Choice, choose
from ahoy_core.cost.pace import measure_pace
from flows.request import VideoRequest
from tasks.cost.errors import psnr
from tasks.cost.measured import MeasuredSet, packaged_set
from tasks.cost.predict import LEAST_GAIN_DB, Clip, Predictor, gains_of

FILE = "budget.json"
STEPS = ("avatar.steps", "coarse.steps")
_SHOWN = 3


@dataclass(frozen=True)
class Budget:
    """What was chosen for a video, and why.

    Attributes:
        overrides: knobs of the run, those that the user fixed last.
        preset: that they change.
        seconds: predicted, wall clock.
        said: lines for a person.
        found: an earlier choice was taken again.
    """

    overrides: tuple[str, ...]
    preset: str
    seconds: float
    said: tuple[str, ...]
    found: bool = False


def budgeted(request: VideoRequest, budget_s: float, measured: MeasuredSet | None = None) -> Budget:
    """Choose the knobs of a request.

    Args:
        request: with a folder or a store; its overrides are kept, their knobs are not chosen.
        budget_s: seconds of wall clock, from the video to the report.
        measured: what is known of cost and gain; the packaged set by default.

    Raises:
        BadInputError: the video cannot be had.
        ValueError: there is no measured set to choose from.
    """
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
        return Budget(tuple(chosen["overrides"]), chosen["preset"], chosen["seconds"], said, found=True)
    fixed = [text.partition("=")[0].strip() for text in request.overrides]
    base = request.model_copy(
        update={"preset": measured.preset, "overrides": (*measured.overrides, *request.overrides)}
    ).settings()
    # A run's stages are measured in CPU seconds of one thread; what they take here is what the unit takes here.
    factor = measure_pace().wall_s / measured.unit_cpu_s
    predictor = Predictor(measured, base, Clip.of(source.path), factor)
    choice = choose(gains_of(measured, fixed), predictor.seconds, budget_s, STEPS)
    overrides = (*measured.overrides, *(f"{k}={json.dumps(v)}" for k, v in choice.changes.items()), *request.overrides)
    said = tuple(_said(choice, measured, predictor, budget_s, factor))
    budget = Budget(overrides, measured.preset, choice.seconds, said)
    if folder:
        folder.mkdir(parents=True, exist_ok=True)
        text = json.dumps({"asked": asked, "choice": asdict(budget)}, indent=1)
        (folder / FILE).write_text(text, encoding="utf-8")
    return budget


def _read(path: Path) -> dict[str, Any] | None:
    try:
        said: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, json.JSONDecodeError):
        return None
    return said if {"asked", "choice"} <= set(said) else None


def _said(choice: Choice, measured: MeasuredSet, predictor: Predictor, budget_s: float, factor: float) -> list[str]:
    lines = [f"budget {_time(budget_s)}: preset {measured.preset}" + _changes(choice)]
    stages = predictor.by_stage(choice.changes)
    dear = sorted(stages, key=lambda name: -stages[name])[:_SHOWN]
    lines.append(
        f"predicted {_time(choice.seconds)} ({', '.join(f'{name} {_time(stages[name])}' for name in dear)}, ...): this "
        f"machine takes {factor:.2f} s now for a CPU second of the measured set's"
    )
    row = measured.whole_row("preset", measured.preset)
    if row is not None:
        known = psnr(row.errors["rmse"])
        lines.append(
            f"predicted gain on the captures that were measured: {choice.gain:+.2f} dB, sharpness counted, over preset "
            f"{measured.preset} ({known:.2f} dB, {(row.cpu_s.median if row.cpu_s else 0) / 60:.1f} CPU minutes)"
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
