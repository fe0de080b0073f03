"""Feeding a batch: creates runs as others end, tries again what crashed, and files what died without a word.

A feeder keeps nothing: killed at any point and started again it reads the ledger and Prefect's runs and goes on. Any
number of feeders of one batch may work at the same time.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Collection
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import Any

import httpx
from prefect.client.schemas.objects import FlowRun, StateType
from prefect.exceptions import PrefectHTTPStatusError

from flows.attempt_rows import CRASHED_SEQUENCE, SEQUENCE_STEP, attempt_row
from flows.batch.plan import Plan, Work, died_silently, plan
from flows.batch.queue import Queue, run_state
from flows.batch.requests import video_parameters
from storage_schema.batches import BatchManifest, is_cancelled, read_batch
from storage_schema.status import BatchStatus, batch_status
from storage_schema.store import ArtifactStore
from storage_schema.tables import Tables

SERVER_GONE_S = 900.0
_AT_MOST = 50  # runs created between two looks at those under way
_Logger = logging.Logger | logging.LoggerAdapter[Any]


@dataclass
class Feeder:
    """Feeds one batch.

    Attributes:
        store, queue: where its manifest and rows are, and its runs.
        outstanding: how many of its runs may be under way or waiting in Prefect.
        tries: how often a video is started if its runs crash.
        poll_s: between two looks.
        pending_s: a run that a worker took and did not start for so long is dead.
        log: where to say what happens.
        progress: told of ended and all videos.
    """

    store: ArtifactStore
    queue: Queue
    outstanding: int
    tries: int
    poll_s: float
    pending_s: float
    log: _Logger
    progress: Callable[[int, int], Awaitable[None]]
    ended: Counter[str] = field(default_factory=Counter)

    def __post_init__(self) -> None:
        self._tables = Tables(self.store)
        self._manifest: BatchManifest = read_batch(self.store, self.queue.batch)

    @classmethod
    def quiet(cls, store: ArtifactStore, queue: Queue) -> Feeder:
        """Return one that looks and files, and is not told to feed."""

        async def nothing(done: int, total: int) -> None:
            return

        return cls(store, queue, 1, 1, 1.0, 1.0, logging.getLogger(__name__), nothing)

    def status(self) -> BatchStatus:
        """How the batch stands by the ledger."""
        return batch_status(self.store, self._tables, self.queue.batch)

    async def reconcile(self) -> None:
        """File videos as crashed that the ledger believes at work while nobody is."""
        dead = died_silently(self.status().records, await self.queue.seen())
        self._append(
            [
                attempt_row(record.video_id, record.attempt_number, CRASHED_SEQUENCE, "crashed")
                | {"run_id": record.run_id or "", "stage": record.stage, "error_class": "Crashed"}
                for record in dead
            ]
        )

    async def feed(self, chosen: Collection[str] | None) -> Counter[str]:
        """Work until every video has ended, or the batch is cancelled.

        Args:
            chosen: see `plan`.

        Returns:
            How many runs ended in which state while this feeder watched.
        """
        todo: Plan | None = None
        total, answered = 0, time.monotonic()
        while todo is None or ((todo.due or todo.live) and not is_cancelled(self.store, self.queue.batch)):
            try:
                if todo is None:
                    todo = plan(self.status().records, await self.queue.seen(), self.tries, chosen)
                    total = len(todo.due) + len(todo.live)
                    if chosen is not None:  # from here on it is the batch's own work, whoever feeds it
                        self._append([_announced(item) for item in todo.due])
                    self.log.info("%s: %d to start, %d under way", self.queue.batch, len(todo.due), len(todo.live))
                await self._watch(todo)
                await self._top_up(todo)
                await self.progress(total - len(todo.due) - len(todo.live), total)
                answered = time.monotonic()
            except (httpx.HTTPError, PrefectHTTPStatusError) as error:
                # The server is restarting or busy: what is lost is this round alone. Gone for good, so is the feeder.
                if time.monotonic() - answered > SERVER_GONE_S:
                    raise
                self.log.warning("Prefect's server did not answer (%s); trying again", type(error).__name__)
            if todo is None or todo.due or todo.live:
                await asyncio.sleep(self.poll_s)
        return self.ended

    async def _watch(self, todo: Plan) -> None:
        found = await self.queue.read(todo.live)
        now = datetime.now(UTC)
        for run in found:
            if run_state(run) == "live" and self._stuck(run, now):
                await self.queue.mark_crashed(run, f"taken by a worker and not started for {self.pending_s:.0f} s")
            elif run_state(run) != "live":
                await self._end(todo, run)
        for missing in set(todo.live) - {str(run.id) for run in found}:
            self.log.warning("run %s was deleted; its video is left as it is", missing)
            del todo.live[missing]

    async def _end(self, todo: Plan, run: FlowRun) -> None:
        work, state = todo.live[str(run.id)], run_state(run)
        if state == "crashed" and not self._said(work, "done"):
            next_try = todo.after_crash(work)
            self._append([self._epitaph(work, run), *([_announced(next_try)] if next_try else [])])
            todo.due += [next_try] if next_try else []
        elif state == "failed" and not self._said(work, "done", "failed"):
            self._append([self._epitaph(work, run)])  # it failed before it could open the store
        elif state == "cancelled":
            self._append([attempt_row(work.video_id, work.attempt, CRASHED_SEQUENCE, "cancelled")])
        self.ended[state] += 1
        del todo.live[str(run.id)]

    def _said(self, work: Work, *states: str) -> bool:
        """Whether a run wrote itself that it ended so, before Prefect heard of its end."""
        mine = [("video_id", "==", work.video_id), ("attempt_number", "==", work.attempt), ("state", "in", states)]
        return self._tables.read("attempts", self.queue.batch, filters=mine).num_rows > 0

    def _epitaph(self, work: Work, run: FlowRun) -> dict[str, Any]:
        """The row that the run could not write; at which stage it was is in its last one."""
        state = run_state(run)
        message = run.state.message if run.state and run.state.message else "the process ended without a word"
        self.log.warning("%s #%d %s: %s", work.video_id, work.attempt, state, message)
        sequence = max(run.run_count, 1) * SEQUENCE_STEP - 1
        return attempt_row(work.video_id, work.attempt, sequence, state) | {
            "flow_run_id": str(run.id),
            "error_class": state.capitalize(),
            "error_message": message,
        }

    async def _top_up(self, todo: Plan) -> None:
        room = max(0, self.outstanding - await self.queue.count_live()) if todo.due else 0
        work = todo.due[: min(room, _AT_MOST)]
        if not work:
            return
        # Announced first: the ledger knows of every try, even one whose run was never created.
        self._append([_announced(item) for item in work])
        entries = {entry.video_id: entry for entry in self._manifest.entries}
        url = self.store.url
        parameters = [video_parameters(self._manifest, entries[w.video_id], w.attempt, url) for w in work]
        for item, run_id in zip(work, await self.queue.create(work, parameters), strict=True):
            todo.live[run_id] = item
        del todo.due[: len(work)]

    def _append(self, rows: list[dict[str, Any]]) -> None:
        if rows:
            self._tables.append("attempts", rows, batch=self.queue.batch)

    def _stuck(self, run: FlowRun, now: datetime) -> bool:
        return (
            run.state_type == StateType.PENDING
            and run.state is not None
            and run.state.timestamp < now - timedelta(seconds=self.pending_s)
        )


def _announced(work: Work) -> dict[str, Any]:
    return attempt_row(work.video_id, work.attempt, -1, "scheduled")
