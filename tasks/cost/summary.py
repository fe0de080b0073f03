"""Rows of several captures as one row a setting, and what is missing of what was declared."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from ahoy_core.cost.sweep import Measurement, Spread
from tasks.cost.change import PRESET, Change
from tasks.cost.declared import END_TO_END, END_TO_END_KNOBS, NOT_SWEPT, STAGE_SWEEPS
from tasks.cost.errors import gain
from tasks.presets import PRESETS
from tasks.settings import Preset

DRAWN = {END_TO_END: ("rmse", "levels of 255"), **{name: one.drawn for name, one in STAGE_SWEEPS.items()}}
"""The error that is drawn, and its unit, by what was swept."""


def over_captures(rows: Sequence[Measurement]) -> list[Measurement]:
    """One row a setting: means over captures of what was measured; failed rows stay as they are.

    The range of the seconds is that of the captures' and repeats' lowest and highest.
    """
    groups: dict[tuple[str, str], list[Measurement]] = {}
    for row in rows:
        if not row.failed:
            groups.setdefault((row.sweep, json.dumps(row.setting, sort_keys=True)), []).append(row)
    return [_mean(group) for group in groups.values()]


def _mean(group: Sequence[Measurement]) -> Measurement:
    first = group[0]
    if len(group) == 1:
        return first
    names = [name for name in first.errors if all(name in row.errors for row in group)]
    return replace(
        first,
        capture=", ".join(row.capture for row in group),
        errors={name: sum(row.errors[name] for row in group) / len(group) for name in names},
        wall_s=_together([row.wall_s for row in group]),
        cpu_s=_together([row.cpu_s for row in group]),
        peak_mb=_together([row.peak_mb for row in group]),
        parts={name: sum(row.parts.get(name, 0.0) for row in group) / len(group) for name in first.parts},
    )


def _together(spreads: Sequence[Spread | None]) -> Spread | None:
    there = [spread for spread in spreads if spread is not None]
    if not there:
        return None
    return Spread(
        sum(spread.median for spread in there) / len(there),
        min(spread.low for spread in there),
        max(spread.high for spread in there),
        sum(spread.repeats for spread in there),
    )


def alike(rows: Sequence[Measurement]) -> list[Measurement]:
    """Rows over the captures that most were run on, as far as one row says: means over others do not compare."""
    most = max((row.capture for row in rows), key=lambda names: names.count(","), default="")
    return [row for row in rows if row.capture == most]


def least_gains(rows: Sequence[Measurement], base: str, preset: str | None = None) -> dict[str, dict[Any, float]]:
    """Knob of whole runs -> value -> dB over the base (`tasks.cost.errors.gain`) on the capture where it gains least.

    Means would be chance: a third of the frames, or smaller ones, move single captures by .3 dB either way. Knobs that
    were not run on all of the base's captures are left out.

    Args:
        rows: of the set.
        base: preset that rows are round unless they name another.
        preset: that the knobs were changed round; the base by default, among whose knobs is `preset` too.
    """
    preset = preset or base
    whole = [(row, Change.of(row.setting, base)) for row in of_sweep(rows, END_TO_END) if not row.failed]
    over = {row.capture: row for row, change in whole if change == Change(base, PRESET, base)}
    found: dict[str, dict[Any, dict[str, float]]] = {}
    for row, change in whole:
        if change.preset == preset and row.capture in over:
            by_capture = found.setdefault(change.knob, {}).setdefault(change.value, {})
            by_capture[row.capture] = gain(row.errors, over[row.capture].errors)
    least = {
        knob: {value: min(gains.values()) for value, gains in values.items() if set(gains) == set(over)}
        for knob, values in found.items()
    }
    return {knob: values for knob, values in least.items() if values}


def of_sweep(rows: Sequence[Measurement], name: str) -> list[Measurement]:
    """Rows of one stage, or of whole runs, by knob and value."""
    return [row for row in rows if row.sweep.partition(".")[0] == name]


def omissions(rows: Sequence[Measurement], base: Preset) -> list[str]:
    """What failed and why, and what was declared and has no row.

    Args:
        rows: of the set.
        base: preset that rows are round unless they name another.
    """
    found = [
        f"{row.sweep} = {shown(row.setting)}, capture {row.capture}: {row.failed.splitlines()[0]}"
        for row in rows
        if row.failed
    ]
    there = {(row.sweep, shown(row.setting)) for row in rows}
    declared: dict[str, Mapping[str, Sequence[Any]]] = {name: one.knobs for name, one in STAGE_SWEEPS.items()}
    declared[END_TO_END] = {PRESET: tuple(PRESETS), **END_TO_END_KNOBS.get(base, {})}
    declared |= {f"{END_TO_END}.{name}": knobs for name, knobs in END_TO_END_KNOBS.items() if name != base}
    for stage, knobs in declared.items():
        for knob, values in knobs.items():
            sweep = f"{stage}.{knob}"
            left = [str(value) for value in values if (sweep, str(value)) not in there]
            if len(left) == len(values):
                found.append(f"{sweep}: not measured yet")
            elif left:
                found.append(f"{sweep} = {', '.join(left)}: not measured yet")
    return found + [f"{stage}: no sweep of its own: {why}" for stage, why in NOT_SWEPT.items()]


def shown(setting: Mapping[str, Any]) -> str:
    """A setting's value as the tables say it; the preset that a whole run is round stands before it, in its sweep."""
    knobs = {knob: value for knob, value in setting.items() if knob != PRESET}
    return ", ".join(str(value) for value in (knobs or setting).values())
