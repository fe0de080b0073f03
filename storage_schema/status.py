"""How a batch stands: a pure fold of its manifest and its rows (a video's own are in `storage_schema.video_status`)."""

from __future__ import annotations

import difflib
import statistics
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import pyarrow as pa

from storage_schema.batches import BatchManifest, is_cancelled, read_batch
from storage_schema.store import ArtifactStore
from storage_schema.tables import Tables
from storage_schema.video_status import (
    ATTEMPT_COLUMNS,
    STAGE_COLUMNS,
    UNFINISHED,
    VIDEO_STATES,
    Row,
    VideoStatus,
    grouped,
    video_status,
)

__all__ = [
    "UNFINISHED",
    "VIDEO_STATES",
    "BatchStatus",
    "Cost",
    "ErrorGroup",
    "VideoStatus",
    "batch_status",
    "fold",
    "select",
]

SLOWEST = 5


@dataclass(frozen=True)
class ErrorGroup:
    """Videos that ended with the same class of error now, and one of them."""

    error_class: str
    count: int
    stages: Mapping[str, int]
    example_video: str
    example_message: str


@dataclass(frozen=True)
class Cost:
    """Wall and CPU seconds spent, failures and repeats included."""

    wall_s: float
    cpu_s: float


@dataclass(frozen=True)
class BatchStatus:
    """How a batch stands.

    Attributes:
        videos: state -> count, every state of `VIDEO_STATES` in it.
        stages: stage -> state -> count of videos; a video that has not come to a stage counts as waiting, unless
            it failed or was cancelled before.
        errors: most frequent first.
        eta_s: seconds until the rest is done if as many videos go on side by side as now (`side_by_side`); None while a
            stage was never measured; 0 when nothing is left.
        cost, cost_by_stage: so far.
        slowest: video -> wall seconds, most first.
        records: one per video, in the order of the manifest.
    """

    batch: str
    created_at: str
    cancelled: bool
    total: int
    videos: Mapping[str, int]
    stages: Mapping[str, Mapping[str, int]]
    errors: tuple[ErrorGroup, ...]
    eta_s: float | None
    side_by_side: int
    cost: Cost
    cost_by_stage: Mapping[str, Cost]
    slowest: Mapping[str, float]
    records: tuple[VideoStatus, ...]

    def to_json(self, records: bool = False) -> dict[str, Any]:
        """Plain JSON types.

        Args:
            records: with one entry per video, which is long.
        """
        value = asdict(self) if records else {k: v for k, v in asdict(_without_records(self)).items() if k != "records"}
        return {"schema_version": 1, **value}


def batch_status(store: ArtifactStore, tables: Tables, batch: str, stages: Sequence[str] = ()) -> BatchStatus:
    """Read a batch's manifest and rows, and fold them.

    Args:
        store: the store.
        tables: of the store; keep it between calls, it remembers what it read.
        batch: the name.
        stages: all stages, in order; those with rows if not given.

    Raises:
        UnknownBatchError, CorruptError, StoreVersionError: see `storage_schema.batches.read_batch`.
    """
    manifest = read_batch(store, batch)
    attempts = tables.read("attempts", batch, columns=ATTEMPT_COLUMNS)
    rows = tables.read("stages", batch, columns=STAGE_COLUMNS)
    return fold(manifest, attempts, rows, cancelled=is_cancelled(store, batch), stages=stages)


def fold(
    manifest: BatchManifest, attempts: pa.Table, rows: pa.Table, *, cancelled: bool = False, stages: Sequence[str] = ()
) -> BatchStatus:
    """How the batch stands.

    Args:
        manifest: of the batch.
        attempts: rows of the table `attempts`; those of videos that are not in the manifest are left out.
        rows: of the table `stages`; likewise.
        cancelled: whether the batch is marked so: what was not started then counts as cancelled.
        stages: all stages, in order; those with rows if not given.
    """
    known = {entry.video_id for entry in manifest.entries}
    by_video = grouped(attempts, ATTEMPT_COLUMNS, known)
    stage_rows = grouped(rows, STAGE_COLUMNS, known)
    names = _stage_names(stages, stage_rows)
    records = tuple(
        video_status(
            entry.video_id,
            entry.source,
            by_video.get(entry.video_id, ()),
            stage_rows.get(entry.video_id, ()),
            cancelled,
        )
        for entry in manifest.entries
    )
    states = Counter(record.state for record in records)
    side_by_side = max(1, states["running"])
    by_stage = _cost_by_stage(names, stage_rows)
    slow = sorted((r for r in records if r.wall_s > 0), key=lambda r: (-r.wall_s, r.video_id))[:SLOWEST]
    return BatchStatus(
        batch=manifest.batch,
        created_at=manifest.created_at,
        cancelled=cancelled,
        total=len(records),
        videos={state: states[state] for state in VIDEO_STATES},
        stages=_stage_counts(names, records),
        errors=_errors(records),
        eta_s=_eta(names, records, stage_rows, side_by_side),
        side_by_side=side_by_side,
        cost=Cost(sum(cost.wall_s for cost in by_stage.values()), sum(cost.cpu_s for cost in by_stage.values())),
        cost_by_stage=by_stage,
        slowest={record.video_id: record.wall_s for record in slow},
        records=records,
    )


def select(
    status: BatchStatus,
    *,
    states: Iterable[str] = (),
    stage: str | None = None,
    error: str | None = None,
    videos: Iterable[str] = (),
) -> tuple[str, ...]:
    """Which videos a rerun is about, in the order of the manifest; every condition that is given has to hold.

    Args:
        status: of the batch.
        states: of the videos. With nothing else given either, those that did not get done: failed, crashed, cancelled.
        stage: where they ended.
        error: class of the error they ended with.
        videos: their ids, whatever their state.

    Raises:
        ValueError: a state, stage, error or video that the batch does not have; the message names those it has.
    """
    wanted, ids = set(states), set(videos)
    _check_choice("state", wanted, set(VIDEO_STATES))
    _check_choice("video", ids, {record.video_id for record in status.records})
    if stage is not None:
        _check_choice("stage", {stage}, set(status.stages))
    if error is not None:
        _check_choice("error", {error}, {group.error_class for group in status.errors})
    if not (wanted or ids):
        wanted = set(UNFINISHED)
    return tuple(
        record.video_id
        for record in status.records
        if (not wanted or record.state in wanted)
        and (not ids or record.video_id in ids)
        and (stage is None or record.stage == stage)
        and (error is None or record.error_class == error)
    )


def _stage_names(stages: Sequence[str], rows: Mapping[str, Sequence[Row]]) -> list[str]:
    found = dict.fromkeys(stages)
    for video in rows.values():
        found.update(dict.fromkeys(row["stage"] for row in video))
    return list(found)


def _stage_counts(names: Sequence[str], records: Sequence[VideoStatus]) -> dict[str, dict[str, int]]:
    counts: dict[str, Counter[str]] = {name: Counter() for name in names}
    for record in records:
        later = None if record.state in ("failed", "cancelled") else "waiting"
        for name in names:
            state = record.stages.get(name, later)
            if state is not None:
                counts[name][state] += 1
    return {name: dict(count) for name, count in counts.items()}


def _cost_by_stage(names: Sequence[str], rows: Mapping[str, Sequence[Row]]) -> dict[str, Cost]:
    wall, cpu = dict.fromkeys(names, 0.0), dict.fromkeys(names, 0.0)
    for video in rows.values():
        for row in video:
            wall[row["stage"]] += row["wall_s"]
            cpu[row["stage"]] += row["cpu_s"] or 0.0
    return {name: Cost(wall[name], cpu[name]) for name in names}


def _errors(records: Sequence[VideoStatus]) -> tuple[ErrorGroup, ...]:
    groups: dict[str, list[VideoStatus]] = defaultdict(list)
    for record in records:
        if record.error_class is not None:
            groups[record.error_class].append(record)
    found = [
        ErrorGroup(
            name,
            len(group),
            dict(Counter(record.stage or "?" for record in group)),
            group[0].video_id,
            next((record.error_message for record in group if record.error_message), ""),
        )
        for name, group in groups.items()
    ]
    return tuple(sorted(found, key=lambda group: (-group.count, group.error_class)))


def _eta(
    names: Sequence[str], records: Sequence[VideoStatus], rows: Mapping[str, Sequence[Row]], side_by_side: int
) -> float | None:
    """Mean measured seconds of the stages that are left, shared by the videos that go on side by side."""
    left = [record for record in records if record.state in ("waiting", "running")]
    if not left:
        return 0.0
    times: dict[str, list[float]] = defaultdict(list)
    for video in rows.values():
        for row in video:
            if row["state"] in ("done", "skipped"):
                times[row["stage"]].append(row["wall_s"])
    if not names or any(name not in times for name in names):
        return None
    mean = {name: statistics.fmean(times[name]) for name in names}
    finished = ("done", "cached", "skipped")
    seconds = sum(mean[name] for record in left for name in names if record.stages.get(name) not in finished)
    return seconds / side_by_side


def _check_choice(what: str, got: set[str], known: set[str]) -> None:
    for name in sorted(got - known):
        close = difflib.get_close_matches(name, known, 3, 0.3) or sorted(known)[:5]
        raise ValueError(f"{what} {name!r}: expected one of those the batch has, such as {close}")


def _without_records(status: BatchStatus) -> BatchStatus:
    return BatchStatus(**{**status.__dict__, "records": ()})
