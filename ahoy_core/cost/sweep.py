"""Sweeps over knobs: every setting timed in turn, its error against a reference, failures kept as omissions."""

from __future__ import annotations

import dataclasses
import gc
import json
import math
import statistics
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

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
    """

    sweep: str
    setting: Mapping[str, Any]
    errors: Mapping[str, float] = field(default_factory=dict)
    wall_s: Spread | None = None
    cpu_s: Spread | None = None
    failed: str = ""


def sweep(
    name: str,
    settings: Iterable[Mapping[str, Any]],
    run: Callable[[Mapping[str, Any]], T],
    error: Callable[[T], Mapping[str, float]],
    *,
    repeats: int = 5,
) -> list[Measurement]:
    """Time `run` at every setting and compare what it returns with a reference.

    Settings take turns (A B C A B C ...), so that a machine that slows down half-way slows them all. Each is run once
    uncounted first: compilation and caches are not what is measured.

    Args:
        name: of the sweep.
        settings: knob values, one mapping a row.
        run: does the work at one setting.
        error: error measures of a result against the reference.
        repeats: counted runs per setting, at least 1.
    """
    if repeats < 1:
        raise ValueError(f"sweep {name}: expected repeats >= 1, got {repeats}; a row without a run has no time")
    rows = [dict(setting) for setting in settings]
    errors: dict[int, dict[str, float]] = {}
    failed: dict[int, str] = {}
    times: dict[int, list[tuple[float, float]]] = {i: [] for i in range(len(rows))}
    for i, setting in enumerate(rows):
        try:
            errors[i] = {key: float(value) for key, value in error(run(setting)).items()}
        except Exception as problem:  # a setting that fails is a finding, not the end of the sweep
            failed[i] = f"{type(problem).__name__}: {problem}"
    for _ in range(repeats):
        for i in errors:
            times[i].append(_timed(run, rows[i]))
    return [
        Measurement(name, row, failed=failed[i])
        if i in failed
        else Measurement(name, row, errors[i], Spread.of([t[0] for t in times[i]]), Spread.of([t[1] for t in times[i]]))
        for i, row in enumerate(rows)
    ]


def _timed(run: Callable[[Mapping[str, Any]], T], setting: Mapping[str, Any]) -> tuple[float, float]:
    gc.collect()
    wall, cpu = time.perf_counter(), time.process_time()
    run(setting)
    return time.perf_counter() - wall, time.process_time() - cpu


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
    rows = []
    for line in path.read_text(encoding="utf-8").splitlines():
        value = json.loads(line)
        for clock in ("wall_s", "cpu_s"):
            value[clock] = Spread(**value[clock]) if value[clock] else None
        rows.append(Measurement(**value))
    return rows
