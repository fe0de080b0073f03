"""Sweeps over knobs: every setting timed in turn, its error against a reference, failures kept as omissions."""

from __future__ import annotations

import dataclasses
import gc
import json
import math
import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from ahoy_core.cost.meter import Bill, Meter

T = TypeVar("T")


@dataclass(frozen=True)
class Spread:
    """Median and range over repeats; a wide range says the machine was noisy."""

    median: float
    low: float
    high: float
    repeats: int

    @classmethod
    def of(cls, values: Sequence[float]) -> Spread:
        """Summarise at least one value."""
        return cls(statistics.median(values), min(values), max(values), len(values))


@dataclass(frozen=True)
class Measurement:
    """One row of a sweep.

    Attributes:
        sweep: what was swept, such as `raster.alpha_cutoff`.
        setting: knob values.
        errors: error measures against the reference, smaller is better; empty if the run failed.
        wall_s, cpu_s: seconds a run, over the repeats.
        failed: why there is no result; such rows are the list of omissions.
        peak_mb: most memory that the process held while it ran, over the repeats.
        capture: what it was measured on, where there are several.
        knobs: `stage.knob` -> value of everything that decides the work, at this setting.
        parts: stage -> CPU seconds, where the run is one of several stages.
        made_of: hash of all that the row depends on; a row with the same need not be measured again.
    """

    sweep: str
    setting: Mapping[str, Any]
    errors: Mapping[str, float] = field(default_factory=dict)
    wall_s: Spread | None = None
    cpu_s: Spread | None = None
    failed: str = ""
    peak_mb: Spread | None = None
    capture: str = ""
    knobs: Mapping[str, Any] = field(default_factory=dict)
    parts: Mapping[str, float] = field(default_factory=dict)
    made_of: str = ""


def sweep(
    name: str,
    settings: Iterable[Mapping[str, Any]],
    run: Callable[[Mapping[str, Any]], T],
    error: Callable[[T], Mapping[str, float]],
    *,
    repeats: int = 5,
    warm: bool = True,
) -> list[Measurement]:
    """Time `run` at every setting and compare what it returns with a reference.

    Settings take turns (A B C A B C ...), so that a machine that slows down half-way slows them all. Each is run once
    uncounted first (`warm`): compilation and caches are not what is measured. An error that is no finite number is a
    failure: the setting did not converge.

    Args:
        name: of the sweep.
        settings: knob values, one mapping a row.
        run: does the work at one setting.
        error: error measures of a result against the reference.
        repeats: counted runs per setting, at least 1.
        warm: off, the first run counts too: for work of many seconds, warmed up by the caller.
    """
    if repeats < 1:
        raise ValueError(f"sweep {name}: expected repeats >= 1, got {repeats}; a row without a run has no time")
    rows = [dict(setting) for setting in settings]
    errors: dict[int, dict[str, float]] = {}
    failed: dict[int, str] = {}
    bills: dict[int, list[Bill]] = {i: [] for i in range(len(rows))}
    for i, setting in enumerate(rows):
        try:
            result, bill = _billed(run, setting)
            errors[i] = {key: float(value) for key, value in error(result).items()}
        except Exception as problem:  # a setting that fails is a finding, not the end of the sweep
            failed[i] = f"{type(problem).__name__}: {problem}"
            continue
        if lost := [key for key, value in errors[i].items() if not math.isfinite(value)]:
            failed[i] = f"did not converge: {', '.join(lost)} is no finite number"
            del errors[i]
        elif not warm:
            bills[i].append(bill)
    for _ in range(repeats if warm else repeats - 1):
        for i in errors:
            bills[i].append(_billed(run, rows[i])[1])
    return [
        Measurement(name, row, failed=failed[i])
        if i in failed
        else Measurement(name, row, errors[i], *_spreads(bills[i])[:2], peak_mb=_spreads(bills[i])[2])
        for i, row in enumerate(rows)
    ]


def _billed(run: Callable[[Mapping[str, Any]], T], setting: Mapping[str, Any]) -> tuple[T, Bill]:
    gc.collect()
    with Meter() as meter:
        result = run(setting)
    return result, meter.read()


def _spreads(bills: Sequence[Bill]) -> tuple[Spread, Spread, Spread]:
    """Wall seconds, CPU seconds and peak memory over the repeats."""
    wall, cpu, peak = zip(*((bill.wall_s, bill.cpu_s, bill.peak_rss_mb) for bill in bills), strict=True)
    return Spread.of(wall), Spread.of(cpu), Spread.of(peak)


def pareto(rows: Iterable[Measurement], error: str) -> list[Measurement]:
    """Return the rows that no other row beats in both CPU time and `error`, cheapest first."""
    ok = [r for r in rows if not r.failed and r.cpu_s is not None and math.isfinite(r.errors.get(error, math.nan))]
    ok.sort(key=lambda r: (r.cpu_s.median if r.cpu_s else math.inf, r.errors[error]))
    best, front = math.inf, []
    for row in ok:
        if row.errors[error] < best:
            best = row.errors[error]
            front.append(row)
    return front


def write_jsonl(path: Path, rows: Iterable[Measurement]) -> None:
    """Write one JSON object a line."""
    path.write_text("".join(json.dumps(dataclasses.asdict(row)) + "\n" for row in rows), encoding="utf-8")


def read_jsonl(path: Path) -> list[Measurement]:
    """Inverse of `write_jsonl`."""
    return [row_of(json.loads(line)) for line in path.read_text(encoding="utf-8").splitlines()]


def row_of(fields: Mapping[str, Any]) -> Measurement:
    """A row from its JSON object."""
    spreads = {name: Spread(**fields[name]) for name in ("wall_s", "cpu_s", "peak_mb") if fields.get(name)}
    plain = {name: value for name, value in fields.items() if name not in ("wall_s", "cpu_s", "peak_mb")}
    return Measurement(**{**plain, **spreads})
