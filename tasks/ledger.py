"""What was measured before, as planning takes it: the ledger's attempts and stages, by video."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

import pyarrow as pa

from ahoy_core.cost.simulate import MeasuredAttempt, MeasuredVideo
from storage_schema.store import ArtifactStore
from storage_schema.tables import Tables

_ENDED = ("done", "failed", "crashed")
_STAGE_COLUMNS = ("batch", "video_id", "attempt_number", "seq", "stage", "state", "wall_s")
_ATTEMPT_COLUMNS = ("batch", "video_id", "attempt_number", "state", "wall_s")


def read_measured(store: ArtifactStore, batches: Sequence[str] = ()) -> list[MeasuredVideo]:
    """Every video of the ledger whose latest attempt has ended.

    Args:
        store: whose tables to read.
        batches: only these; all if empty.
    """
    tables = Tables(store)
    return measured(
        _read(tables, "stages", batches, _STAGE_COLUMNS), _read(tables, "attempts", batches, _ATTEMPT_COLUMNS)
    )


def measured(stages: pa.Table, attempts: pa.Table) -> list[MeasuredVideo]:
    """Fold rows into videos.

    An attempt that found everything in the store tells nothing about the work and is left out. What an attempt took
    beside its stages is its overhead; where the ledger does not say how long the attempt was, there is none. A video
    without rows of attempts (a single `ahoy run`) counts as one attempt, done unless a stage failed.
    """
    steps: dict[tuple[str, str], dict[int, list[Row]]] = defaultdict(lambda: defaultdict(list))
    for row in stages.select(list(_STAGE_COLUMNS)).to_pylist():
        steps[(row["batch"], row["video_id"])][row["attempt_number"]].append(row)
    ends: dict[tuple[str, str], dict[int, list[Row]]] = defaultdict(lambda: defaultdict(list))
    for row in attempts.select(list(_ATTEMPT_COLUMNS)).to_pylist():
        ends[(row["batch"], row["video_id"])][row["attempt_number"]].append(row)
    videos = []
    for video, numbers in steps.items():
        if ends[video] and not any(row["state"] in _ENDED for row in ends[video][max(ends[video])]):
            continue
        tried = [_attempt(rows, ends[video].get(number, ())) for number, rows in sorted(numbers.items())]
        if kept := tuple(attempt for attempt in tried if attempt is not None):
            videos.append(MeasuredVideo(kept))
    return videos


Row = Mapping[str, Any]


def _attempt(rows: Sequence[Row], ends: Sequence[Row]) -> MeasuredAttempt | None:
    rows = sorted(rows, key=lambda row: row["seq"])
    if all(row["state"] == "cached" for row in rows):
        return None
    steps = tuple((row["stage"], row["wall_s"]) for row in rows if row["state"] != "cached")
    whole = max((row["wall_s"] or 0.0 for row in ends), default=0.0)
    overhead = max(0.0, whole - sum(row["wall_s"] for row in rows))
    states = [row["state"] for row in ends] or [row["state"] for row in rows]
    done = "done" in states if ends else "failed" not in states
    return MeasuredAttempt(steps, overhead, done)


def _read(tables: Tables, name: str, batches: Sequence[str], columns: Sequence[str]) -> pa.Table:
    if not batches:
        return tables.read(name, columns=columns)
    return pa.concat_tables([tables.read(name, batch, columns=columns) for batch in batches])
