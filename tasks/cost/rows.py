"""The rows of `ahoy cost` on disk: one JSON line each, appended as they are measured, and the same as Parquet."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from ahoy_core.cost.sweep import Measurement, read_jsonl

ROWS, TABLE = "rows.jsonl", "rows.parquet"


class Rows:
    """Rows of a folder; a line is written as soon as its row is there, so that a killed sweep goes on behind it.

    Args:
        folder: of the sweep; made if it is not there.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / ROWS
        folder.mkdir(parents=True, exist_ok=True)
        if self._path.is_file():
            text = self._path.read_bytes()
            if not text.endswith(b"\n"):  # a line was being written when its process was killed
                self._path.write_bytes(text[: text.rfind(b"\n") + 1])
        self.rows: list[Measurement] = read_jsonl(self._path) if self._path.is_file() else []

    def reuse(self, made_of: str, sweep: str, setting: Mapping[str, Any], repeats: int) -> bool:
        """Whether a row with this hash is there, under the name of this sweep or, from now on, also under it.

        The base value of a knob is a setting of every other knob's sweep too, and needs measuring once. A setting that
        failed, or was run less often than is asked now, is tried again.
        """
        same = [row for row in self.rows if row.made_of == made_of and row.cpu_s and row.cpu_s.repeats >= repeats]
        if not same:
            return False
        if all(row.sweep != sweep for row in same):
            self.add(dataclasses.replace(same[0], sweep=sweep, setting=dict(setting)))
        return True

    def add(self, row: Measurement) -> None:
        """Keep a row; it replaces one of the same setting."""
        stale = [old for old in self.rows if (old.sweep, old.setting, old.capture) == _which(row)]
        self.rows = [old for old in self.rows if old not in stale] + [row]
        text = "".join(json.dumps(dataclasses.asdict(one)) + "\n" for one in (self.rows if stale else [row]))
        if not stale:
            with self._path.open("a", encoding="utf-8") as file:
                file.write(text)
            return
        partial = self._path.with_suffix(".partial")
        partial.write_text(text, encoding="utf-8")
        partial.replace(self._path)


def _which(row: Measurement) -> tuple[str, Mapping[str, Any], str]:
    return row.sweep, row.setting, row.capture


def write_table(path: Path, rows: Sequence[Measurement]) -> None:
    """The rows as Parquet, a column a figure; settings, knobs and parts as JSON text."""
    flat = []
    for row in rows:
        figures: dict[str, Any] = {"capture": row.capture, "sweep": row.sweep, "made_of": row.made_of}
        figures |= {name: json.dumps(getattr(row, name)) for name in ("setting", "knobs", "parts")}
        for name, spread in (("wall_s", row.wall_s), ("cpu_s", row.cpu_s), ("peak_mb", row.peak_mb)):
            figures |= {
                f"{name}_{part}": getattr(spread, part) if spread else None for part in ("median", "low", "high")
            }
        figures |= {"repeats": row.cpu_s.repeats if row.cpu_s else 0, "failed": row.failed}
        flat.append({**figures, **{f"error_{name}": value for name, value in row.errors.items()}})
    columns = list(dict.fromkeys(name for row in flat for name in row))
    pq.write_table(pa.Table.from_pylist([{name: row.get(name) for name in columns} for row in flat]), path)
