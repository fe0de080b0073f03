"""Which videos of a batch are due, and as which attempt: a pure function of the ledger and of what Prefect says.

The ledger (the store's tables) outlives any server, and Prefect knows of runs that died without a word. Attempt numbers
make the two agree: a run is created under a key that holds batch, video and number, so that whoever plans the same
twice creates it once.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Literal

from storage_schema.video_status import VideoStatus

RunState = Literal["live", "done", "failed", "crashed", "cancelled"]


@dataclass(frozen=True)
class SeenRun:
    """A flow run of a video, as Prefect has it."""

    video_id: str
    attempt: int
    state: RunState
    flow_run_id: str


@dataclass(frozen=True)
class Work:
    """A try that has to be made."""

    video_id: str
    attempt: int


@dataclass
class Plan:
    """What a feeder has to do.

    Attributes:
        due: tries to create, in the order of the batch.
        live: flow run id -> the try it is, to be watched.
        last_attempt: video -> number of the last try that a crash may lead to.
    """

    due: list[Work] = field(default_factory=list)
    live: dict[str, Work] = field(default_factory=dict)
    last_attempt: dict[str, int] = field(default_factory=dict)

    def after_crash(self, work: Work) -> Work | None:
        """Return the next try of a video whose run crashed, None if there were enough."""
        return Work(work.video_id, work.attempt + 1) if work.attempt < self.last_attempt[work.video_id] else None


def plan(
    records: Iterable[VideoStatus], runs: Iterable[SeenRun], tries: int, chosen: Collection[str] | None = None
) -> Plan:
    """Decide for each video.

    Args:
        records: the batch, in order.
        runs: every flow run of the batch.
        tries: how often a video is started if its runs crash.
        chosen: start these again, whatever became of them, and leave the others alone; None goes on with the batch:
            those never tried and those that crashed.
    """
    latest = latest_runs(runs)
    made = Plan()
    for record in records:
        if chosen is not None and record.video_id not in chosen:
            continue
        run = latest.get(record.video_id)
        number = max(record.attempt_number, run.attempt if run else 0)
        made.last_attempt[record.video_id] = tries if chosen is None else number + tries
        if run is not None and run.state == "live":
            made.live[run.flow_run_id] = Work(record.video_id, run.attempt)
            made.last_attempt[record.video_id] = max(made.last_attempt[record.video_id], run.attempt)
        elif chosen is not None:
            made.due.append(Work(record.video_id, number + (0 if _announced_only(record, run) else 1)))
        elif (work := _unfinished(record, run, number)) is not None and work.attempt <= tries:
            made.due.append(work)
    return made


def latest_runs(runs: Iterable[SeenRun]) -> Mapping[str, SeenRun]:
    """The run with the highest attempt number of each video."""
    latest: dict[str, SeenRun] = {}
    for run in runs:
        if run.video_id not in latest or run.attempt > latest[run.video_id].attempt:
            latest[run.video_id] = run
    return latest


def died_silently(records: Iterable[VideoStatus], runs: Iterable[SeenRun]) -> list[VideoStatus]:
    """Videos that the ledger believes at work while no live run is."""
    latest = latest_runs(runs)
    at_work = [record for record in records if record.state == "running"]
    return [r for r in at_work if (run := latest.get(r.video_id)) is None or run.state != "live"]


def _unfinished(record: VideoStatus, run: SeenRun | None, number: int) -> Work | None:
    """The next try of a video that is neither done nor failed nor cancelled."""
    if record.state in ("done", "failed", "cancelled"):
        return None
    if run is not None and run.attempt >= record.attempt_number and run.state in ("done", "failed", "cancelled"):
        return None
    if number == 0 or _announced_only(record, run):
        return Work(record.video_id, max(number, 1))
    return Work(record.video_id, number + 1)


def _announced_only(record: VideoStatus, run: SeenRun | None) -> bool:
    """The ledger has a row for the next try, and its run was never created: a feeder was killed in between."""
    return (
        record.attempt_number > (run.attempt if run else 0)
        and record.run_id == ""
        and record.state in ("waiting", "cancelled")
    )
