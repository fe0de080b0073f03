"""What became slower or less accurate: `python -m benchmarks.compare OLD NEW`, both JSON lines of the same benchmark.

Works on the lines of `ahoy cost` (rows.jsonl) and of every benchmark here that writes JSON lines. Two lines belong
together if all that is no figure agrees: names, settings, whole numbers without a direction. A figure's direction and
the difference that counts come from its name:

- seconds, milliseconds and memory: 10% (`--time`), wall clock only with `--wall`: it measures the machine's other work;
- PSNR 0.1 dB, SSIM and IoU 0.005, other errors 2% (`--accuracy` scales all of these).

Where a figure comes with its range over repeats, the ranges of old and new must also not overlap. A row that has become
a failure is worse; one that is gone is named. Exit status 1 if anything is worse.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

Kind = Literal["time", "accuracy"]
_IDENTITY_IN = ("setting", "knobs")  # numbers in here are what was set, not what was measured
_SAID = (
    "machine",
    "packages",
    "notes",
    "failed",
    "made_of",
    "betas",
    "corrections",
    "load_average",
    "parts",
    "protocol",
)
_LOW = (
    "_s",
    "_ms",
    "_mb",
    "_mm",
    "_m",
    "l1",
    "error",
    "errors",
    "rmse",
    "loss",
    "distance",
    "jitter",
    "perceptual",
    "gradient",
)
_HIGH = ("psnr", "ssim", "iou", "fps", "per_s")
_TIME = ("_s", "_ms", "_mb", "seconds", "fps", "per_s")
_ABSOLUTE = {"psnr": 0.1, "ssim": 0.005, "iou": 0.005}
_SPREAD = {"median", "low", "high"}


@dataclass(frozen=True)
class Figure:
    """A measured number with its range; `better` is "low" or "high"."""

    value: float
    low: float
    high: float
    better: str
    kind: Kind


@dataclass(frozen=True)
class Change:
    """A figure that moved beyond noise, or a row that fails or is gone."""

    row: str
    figure: str
    before: str
    after: str
    worse: bool


def compare(
    old: Sequence[Mapping[str, Any]], new: Sequence[Mapping[str, Any]], options: argparse.Namespace
) -> list[Change]:
    """Changes beyond noise, in the order of the old rows."""
    after = dict(_identified(new))
    changes = []
    for name, row in _identified(old):
        if name not in after:
            changes.append(Change(name, "row", "there", "gone", False))
            continue
        theirs = after[name]
        if theirs.get("failed") and not row.get("failed"):
            changes.append(Change(name, "row", "measured", str(theirs["failed"]).splitlines()[0], True))
            continue
        mine, figures = dict(_figures(row)), dict(_figures(theirs))
        for key in mine.keys() & figures.keys():
            if ("wall" in key or key == "seconds") and not options.wall:
                continue
            if change := _changed(name, key, mine[key], figures[key], options):
                changes.append(change)
    return changes


def _changed(row: str, key: str, old: Figure, new: Figure, options: argparse.Namespace) -> Change | None:
    worsening = (new.value - old.value) * (1 if old.better == "low" else -1)
    if abs(worsening) <= _tolerance(key, old, options):
        return None
    if new.low <= old.high and old.low <= new.high and (old.low, new.low) != (old.high, new.high):
        return None
    return Change(row, key, f"{old.value:.4g}", f"{new.value:.4g}", worsening > 0)


def _tolerance(key: str, old: Figure, options: argparse.Namespace) -> float:
    if old.kind == "time":
        return float(options.time) * abs(old.value)
    name = key.rpartition(".")[2]
    absolute = next((step for part, step in _ABSOLUTE.items() if part in name), None)
    return float(options.accuracy) * (absolute if absolute is not None else 0.02 * abs(old.value))


def _identified(rows: Sequence[Mapping[str, Any]]) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Rows by all that is no figure; equal ones are told apart by their order."""
    seen: dict[str, int] = {}
    for row in rows:
        said = {key: value for key, value in _leaves(row) if _names(key, value)}
        if not dict(_figures(row)) and not row.get("failed"):
            continue  # a line about the machine
        name = ", ".join(f"{key}={value}" for key, value in sorted(said.items()))
        seen[name] = seen.get(name, 0) + 1
        yield (name if seen[name] == 1 else f"{name} (number {seen[name]})"), row


def _names(key: str, value: Any) -> bool:
    if value is None or any(part in _SAID for part in key.split(".")):
        return False
    if any(part in _IDENTITY_IN for part in key.split(".")):
        return key.split(".")[0] != "knobs"
    return isinstance(value, str | bool) or (isinstance(value, int) and _direction(key) is None)


def _figures(row: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, Figure]]:
    for key, value in row.items():
        name = f"{path}.{key}" if path else key
        if key in _SAID or key in _IDENTITY_IN:
            continue
        direction = _direction(name)
        if isinstance(value, Mapping) and set(value) >= _SPREAD:
            if direction:
                yield name, Figure(value["median"], value["low"], value["high"], direction, _kind(name))
        elif isinstance(value, Mapping):
            yield from _figures(value, name)
        elif direction and isinstance(value, int | float) and not isinstance(value, bool):
            yield name, Figure(value, value, value, direction, _kind(name))


def _direction(key: str) -> str | None:
    """Which way is better, from the name of the figure or of the group that it is in."""
    for part in reversed(key.split(".")):
        if any(word in part for word in _HIGH) and not part.endswith("loss"):
            return "high"
        if part.endswith(_LOW) or "seconds" in part:
            return "low"
    return None


def _kind(key: str) -> Kind:
    return "time" if any(part.endswith(_TIME) or "seconds" in part for part in key.split(".")) else "accuracy"


def _leaves(row: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in row.items():
        name = f"{path}.{key}" if path else key
        if isinstance(value, Mapping):
            if not set(value) >= _SPREAD:
                yield from _leaves(value, name)
        elif not isinstance(value, list):
            yield name, value


def read_lines(path: Path) -> list[dict[str, Any]]:
    """The JSON objects of a file, one a line.

    Raises:
        ValueError: a line is none.
    """
    try:
        rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines() if line.strip()]
    except (OSError, json.JSONDecodeError) as error:
        raise ValueError(
            f"expected JSON lines in {path}, got {error}; give what a benchmark wrote with --json"
        ) from None
    if not all(isinstance(row, dict) for row in rows):
        raise ValueError(f"expected a JSON object a line in {path}, got something else")
    return rows


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("old", type=Path)
    parser.add_argument("new", type=Path)
    parser.add_argument("--time", type=float, default=0.1, help="share of seconds or memory that counts")
    parser.add_argument("--accuracy", type=float, default=1.0, help="factor on the differences of accuracy that count")
    parser.add_argument("--wall", action="store_true", help="compare wall-clock times too")
    options = parser.parse_args(arguments)
    try:
        old, new = read_lines(options.old), read_lines(options.new)
    except ValueError as error:
        parser.error(str(error))
    changes = compare(old, new, options)
    for change in sorted(changes, key=lambda one: not one.worse):
        word = "WORSE " if change.worse else "gone  " if change.after == "gone" else "better"
        print(f"{word} {change.figure}: {change.before} -> {change.after}   [{change.row}]")
    worse = sum(change.worse for change in changes)
    print(f"{len(dict(_identified(old)))} rows compared, {worse} figures worse beyond noise")
    return 1 if worse else 0


if __name__ == "__main__":
    sys.exit(main())
