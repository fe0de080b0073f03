"""The measured set that ships with the package: what runs cost and score, for budgets, presets and reports."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from importlib import resources
from pathlib import Path
from typing import Any

from ahoy_core.cost.sweep import Measurement, row_of
from ahoy_core.cost.work import Knobs, TimeModel, fit_times
from tasks.cost.change import PRESET
from tasks.cost.declared import END_TO_END
from tasks.cost.errors import psnr
from tasks.cost.summary import least_gains, of_sweep, over_captures
from tasks.presets import PRESETS
from tasks.settings import Preset

ASSET = "cost.json"
VERSION = 1


@dataclass(frozen=True)
class MeasuredSet:
    """Rows, and the machine they were measured on.

    Attributes:
        rows: a row a capture and setting.
        unit_cpu_s: CPU seconds of one unit of `ahoy_core.cost.pace` there.
        machine: what it is.
        preset, overrides: the base settings that knobs were changed around.
    """

    rows: tuple[Measurement, ...]
    unit_cpu_s: float
    machine: Mapping[str, Any]
    preset: Preset
    overrides: tuple[str, ...]

    @cached_property
    def times(self) -> TimeModel:
        """Seconds of every stage at any knobs."""
        return fit_times(_stage_times(self.rows))

    @cached_property
    def whole(self) -> tuple[Measurement, ...]:
        """Whole runs: one row a setting, means over captures."""
        return tuple(of_sweep(over_captures(self.rows), END_TO_END))

    def whole_row(self, knob: str, value: Any) -> Measurement | None:
        """The whole run at `knob=value`, or at `preset=NAME`."""
        return next((row for row in self.whole if dict(row.setting) == {knob: value}), None)

    def gains(self, preset: Preset | None = None) -> dict[str, dict[Any, float]]:
        """Knob -> value -> dB over a preset, each over the base on the capture where that is least.

        So that a single change of any preset is worth what its row is worth (`tasks.cost.summary.least_gains`).

        Args:
            preset: of `rounds`; the base by default. Its own row was measured without overrides or not at all.
        """
        known, own = least_gains(self.rows, self.preset, preset), self.rounds().get(preset or self.preset, 0.0)
        return {
            knob: {value: gained - own for value, gained in values.items()}
            for knob, values in known.items()
            if knob != PRESET
        }

    def rounds(self) -> dict[Preset, float]:
        """Presets that were run whole on all of the base's captures -> dB over it where they gain least."""
        return dict(least_gains(self.rows, self.preset).get(PRESET, {}))


def _stage_times(rows: Sequence[Measurement]) -> Iterator[tuple[str, Knobs, float]]:
    for row in rows:
        if row.failed or row.cpu_s is None or not row.knobs:
            continue
        if row.parts:
            yield from ((stage, row.knobs, seconds) for stage, seconds in row.parts.items())
        else:
            yield row.sweep.partition(".")[0], row.knobs, row.cpu_s.median


def cited(preset: str, measured: MeasuredSet) -> str:
    """What a preset costs and scores, from its row."""
    row = measured.whole_row("preset", preset)
    if row is None or row.cpu_s is None:
        return f"preset {preset}: no whole run of it has been measured yet (docs/cost.md, omissions)"
    known = psnr(row.errors["rmse"])
    sharp = f", perceptual distance {row.errors['perceptual']:.3f}" if "perceptual" in row.errors else ""
    minutes = row.cpu_s.median / 60
    return f"preset {preset}: {minutes:.1f} CPU minutes, {known:.2f} dB{sharp} on {row.capture} (docs/cost.md)"


def write_measured(path: Path, rows: Sequence[Measurement], facts: Mapping[str, Any]) -> None:
    """Write the set as JSON, a row a line."""
    kept = [json.dumps(dataclasses.asdict(row)) for row in rows if not row.failed]
    head = json.dumps({"schema_version": VERSION, **facts})
    path.write_text(head[:-1] + ', "rows": [\n' + ",\n".join(kept) + "\n]}\n", encoding="utf-8")


def read_measured(text: str) -> MeasuredSet:
    """Inverse of `write_measured`.

    Raises:
        ValueError: another version.
    """
    said = json.loads(text)
    if said.get("schema_version") != VERSION:
        raise ValueError(
            f"expected a measured set of version {VERSION}, got {said.get('schema_version')}; make it anew"
        )
    rows = tuple(row_of(row) for row in said["rows"])
    base = said["base"]
    preset = next((name for name in PRESETS if name == base["preset"]), None)
    if preset is None:
        raise ValueError(f"expected a measured set round a preset of {', '.join(PRESETS)}, got {base['preset']!r}")
    return MeasuredSet(rows, float(said["unit_cpu_s"]), said["machine"], preset, tuple(base["overrides"]))


@cache
def packaged_set() -> MeasuredSet:
    """The set that ships with the package."""
    return read_measured(resources.files("ahoy_core.assets").joinpath(ASSET).read_text(encoding="utf-8"))
