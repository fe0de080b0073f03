"""The bill of a run beside what was predicted, and what single knobs would have bought: for the report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ahoy_core.cost.choose import Alternative, alternatives, worth_telling
from ahoy_core.cost.work import FRAMES, KNOBS, PIXELS, WORK
from storage_schema.store import Manifest
from tasks.cost.measured import MeasuredSet
from tasks.cost.predict import LEAST_GAIN_DB, gains_of, ingested, work_knobs
from tasks.presets import PRESETS
from tasks.settings import Preset
from tasks.stage import StageContext

_TOLD = 5


@dataclass(frozen=True)
class BillRow:
    """One stage; `predicted_s` are CPU seconds on the set's machine, None where nothing was measured of it before."""

    stage: str
    wall_s: float
    cpu_s: float
    peak_rss_mb: float
    predicted_s: float | None


@dataclass(frozen=True)
class RunBill:
    """A run's bill.

    Attributes:
        rows: a stage each.
        buys: single changes that would have gained accuracy, what gains most a second first.
        saves: single changes that would have saved time, what costs least accuracy first.
        factor: CPU seconds here for one on the set's machine, over the stages that were predicted.
        measured_on: what gains and rates were measured on, in words.
    """

    rows: tuple[BillRow, ...]
    buys: tuple[Alternative, ...]
    saves: tuple[Alternative, ...]
    factor: float
    measured_on: str


def run_bill(ctx: StageContext, measured: MeasuredSet) -> RunBill:
    """Read the bills of a run's stages and set beside them what the measured set says.

    Args:
        ctx: of the report, with the manifests of all stages that were made.
        measured: what is known of cost and gain.
    """
    knobs = known_knobs(ctx)
    predicted = _seconds(measured, knobs)
    rows = []
    for title, manifest in ctx.manifests.items():
        bill = manifest.summary["bill"]
        rows.append(BillRow(title, bill["wall_s"], bill["cpu_s"], bill["peak_rss_mb"], predicted.get(manifest.stage)))
    told = [row for row in rows if row.predicted_s]
    factor = sum(row.cpu_s for row in told) / max(sum(row.predicted_s or 0.0 for row in told), 1e-9) if told else 1.0
    preset = nearest_round(measured, knobs)
    gains = gains_of(measured, preset=preset)
    now = {knob: value for knob in gains.by_knob if (value := _value(ctx.manifests, knob)) is not None}

    def seconds(changes: Mapping[str, Any]) -> float:
        return factor * sum(_seconds(measured, {**knobs, **_work(changes, now, knobs)}).values())

    found = alternatives(gains, now, seconds)
    buys, saves = worth_telling(found, LEAST_GAIN_DB, _TOLD)
    captures = ", ".join(sorted({row.capture for row in measured.rows}))
    where = f"captures {captures}, round preset {preset}, on {measured.machine['cpu']}"
    return RunBill(tuple(rows), tuple(buys), tuple(saves), factor, where)


def nearest_round(measured: MeasuredSet, knobs: Mapping[str, Any]) -> Preset:
    """The preset with measured knobs that most of a run's knobs are those of: what a knob gains depends on the others.

    Args:
        measured: what is known of gain.
        knobs: what decided the run's work, by name.
    """

    def alike(preset: Preset) -> int:
        theirs = work_knobs(PRESETS[preset], {FRAMES: 0, PIXELS: 0})
        return sum(knobs.get(name) == value for name, value in theirs.items())

    return max((name for name in measured.rounds() if measured.gains(name)), key=alike, default=measured.preset)


def known_knobs(ctx: StageContext) -> dict[str, Any]:
    """What decided the work of the stages that were made, by name."""
    found: dict[str, Any] = {**ingested(ctx.inputs["ingest"])}
    for knob in KNOBS:
        if knob not in found and (value := _value(ctx.manifests, knob)) is not None:
            found[knob] = value
    return found


def _seconds(measured: MeasuredSet, knobs: Mapping[str, Any]) -> dict[str, float]:
    """CPU seconds on the set's machine of the stages whose knobs are known."""
    needed = {stage: [name for name in KNOBS if name.startswith(f"{stage}.")] for stage in WORK}
    there = [stage for stage in measured.times.rates if all(name in knobs for name in needed[stage])]
    return {stage: float(measured.times.seconds(stage, knobs) or 0.0) for stage in there}


def _work(changes: Mapping[str, Any], now: Mapping[str, Any], knobs: Mapping[str, Any]) -> dict[str, Any]:
    """Knobs of the work after a change; ingest's say what the later stages are given."""
    found = {name: value for name, value in changes.items() if name in KNOBS}
    if (most := changes.get("ingest.max_frames")) != now.get("ingest.max_frames") and most:
        # A video that is shorter than the limit was not thinned, and is not lengthened by a larger one.
        found[FRAMES] = min(most, knobs[FRAMES]) if knobs[FRAMES] < (now["ingest.max_frames"] or 0) else most
    if (side := changes.get("ingest.max_size")) != now.get("ingest.max_size") and side:
        found[PIXELS] = round(knobs[PIXELS] * min(1.0, side / now["ingest.max_size"]) ** 2)
    return found


def _value(manifests: Mapping[str, Manifest], knob: str) -> Any:
    stage, _, name = knob.partition(".")
    return manifests[stage].config.get(name) if stage in manifests else None
