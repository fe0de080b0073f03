"""How one video of a batch stands: a pure fold of its rows.

Rows come from many machines whose clocks disagree, so nothing here is ordered by time: the attempt with the highest
number counts, within it the row with the highest sequence number, except that an attempt which finished has finished,
whoever reported what about it before or after.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import pyarrow as pa

from storage_schema.schemas import ATTEMPT_STATES

VIDEO_STATES = ("waiting", "running", "done", "failed", "crashed", "cancelled")
UNFINISHED = ("failed", "crashed", "cancelled")
STAGE_COLUMNS = (
    "video_id", "run_id", "stage", "state", "error_class", "error_message", "wall_s", "cpu_s", "attempt_number", "seq",
)  # fmt: skip
ATTEMPT_COLUMNS = (
    "video_id", "run_id", "attempt_number", "seq", "state", "stage", "flow_run_id", "worker", "error_class",
    "error_message",
)  # fmt: skip


Row = dict[str, Any]


@dataclass(frozen=True)
class VideoStatus:
    """Where one video stands.

    Attributes:
        state: one of `VIDEO_STATES`.
        attempt_number: the latest, 0 if none was made.
        stage: where it is or where it ended; None if unknown.
        stages: stage -> state of its latest row (`storage_schema.schemas.STATES`, or running).
        wall_s, cpu_s: over all attempts.
    """

    video_id: str
    source: str
    state: str
    attempt_number: int = 0
    run_id: str | None = None
    flow_run_id: str | None = None
    worker: str | None = None
    stage: str | None = None
    error_class: str | None = None
    error_message: str | None = None
    stages: Mapping[str, str] = field(default_factory=dict)
    wall_s: float = 0.0
    cpu_s: float = 0.0


def grouped(table: pa.Table, columns: Sequence[str], known: set[str]) -> dict[str, list[Row]]:
    """Rows by video, in the order in which they happened.

    Args:
        table: rows of `stages` or `attempts`.
        columns: `STAGE_COLUMNS` or `ATTEMPT_COLUMNS`.
        known: videos that count.
    """
    values = [table[column].to_pylist() for column in columns]
    grouped: dict[str, list[Row]] = defaultdict(list)
    for row in zip(*values, strict=True):
        if row[0] in known:
            grouped[row[0]].append(dict(zip(columns, row, strict=True)))
    for rows in grouped.values():
        rows.sort(key=lambda row: (row["attempt_number"], row["seq"], row["run_id"]))
    return grouped


def video_status(
    video_id: str, source: str, attempts: Sequence[Row], rows: Sequence[Row], cancelled: bool
) -> VideoStatus:
    """Fold what is known of a video.

    Args:
        video_id: as in the batch's manifest.
        source: likewise.
        attempts: its rows of that table, in order (`grouped`).
        rows: its rows of the table `stages`, in order.
        cancelled: whether its batch is: what was not started then counts as cancelled.
    """
    latest = _latest_attempt(attempts)
    number, state, stage = latest["attempt_number"], _video_state(latest["state"], cancelled), latest["stage"]
    states = {row["stage"]: row["state"] for row in rows}
    mine = [row for row in rows if row["attempt_number"] == number]
    if state == "running" and stage is not None and all(row["stage"] != stage for row in mine):
        states[stage] = "running"
    error_class = error_message = None
    if state in ("failed", "crashed"):
        failed = next((row for row in reversed(mine) if row["state"] == "failed"), {})
        error = latest if latest["error_class"] else failed
        stage = stage or failed.get("stage")
        error_class, error_message = error.get("error_class") or state.capitalize(), error.get("error_message")
    return VideoStatus(
        video_id=video_id,
        source=source,
        state=state,
        attempt_number=number,
        run_id=latest["run_id"],
        flow_run_id=latest["flow_run_id"],
        worker=latest["worker"],
        stage=stage,
        error_class=error_class,
        error_message=error_message,
        stages=states,
        wall_s=sum(row["wall_s"] for row in rows),
        cpu_s=sum(row["cpu_s"] or 0.0 for row in rows),
    )


def _video_state(state: str, cancelled: bool) -> str:
    if state != "scheduled":
        return state
    return "cancelled" if cancelled else "waiting"


def _latest_attempt(attempts: Sequence[Row]) -> Row:
    """The row that says how the latest attempt stands, what it leaves open filled in from earlier rows of it."""
    if not attempts:
        return {**dict.fromkeys(ATTEMPT_COLUMNS), "attempt_number": 0, "state": "scheduled"}
    number = attempts[-1]["attempt_number"]
    mine = [row for row in attempts if row["attempt_number"] == number]
    last = max(mine, key=lambda row: (row["state"] == "done", row["seq"], ATTEMPT_STATES.index(row["state"])))
    filled = dict(last)
    for column in ("stage", "flow_run_id", "worker"):
        if filled[column] is None:
            filled[column] = next((row[column] for row in reversed(mine) if row[column] is not None), None)
    return filled
