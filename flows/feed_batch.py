"""The Prefect flow that feeds a batch; a deployment of its own, so it can be started from the UI's form, too."""

from __future__ import annotations

import time
from datetime import UTC, datetime, timedelta
from typing import Any, Literal
from uuid import UUID

from prefect import flow
from prefect.artifacts import acreate_progress_artifact, acreate_table_artifact, aupdate_progress_artifact
from prefect.client.orchestration import get_client
from prefect.logging import get_run_logger
from prefect.runtime import flow_run
from pydantic import BaseModel, ConfigDict, Field

from flows.batch.feeder import Feeder
from flows.batch.queue import Queue, QueueError
from storage_schema.batches import is_cancelled, resume_batch
from storage_schema.status import BatchStatus, select
from storage_schema.store import ArtifactStore

UPDATE_S = 5.0
MOST_CRASHES, CRASHES_WITHIN = 20, timedelta(hours=1)
Rerun = Literal["no", "unfinished", "failed", "crashed", "cancelled"]


class FeedRequest(BaseModel):
    """Parameters of the flow `feed_batch`; the Prefect UI builds its form from this model."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    store: str = Field(description="URL of the artifact store")
    batch: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$", description="name of the batch")
    rerun: Rerun = Field("no", description="run these again; 'no' goes on with the batch")
    stage: str | None = Field(None, description="run again only what ended at this stage")
    error: str | None = Field(None, description="run again only what ended with this class of error")
    videos: tuple[str, ...] = Field((), description="run again only these videos")
    outstanding: int = Field(100, ge=1, le=2000, description="runs that may wait or be under way at a time")
    tries: int = Field(3, ge=1, le=20, description="how often a video is started if its process crashes")
    poll_s: float = Field(2.0, gt=0, le=60, description="seconds between two looks at the runs")
    pending_s: float = Field(300.0, gt=0, description="a run that was taken and not started for so long is dead")

    @property
    def selects(self) -> bool:
        """Whether a part of the batch is to run again."""
        return self.rerun != "no" or bool(self.stage or self.error or self.videos)

    def chosen(self, status: BatchStatus) -> tuple[str, ...]:
        """Ids of the videos to run again.

        Raises:
            ValueError: a stage, error or video that the batch does not have.
        """
        states = () if self.rerun in ("no", "unfinished") else (self.rerun,)
        return select(status, states=states, stage=self.stage, error=self.error, videos=self.videos)


@flow(name="feed-batch", flow_run_name="feed {request.batch}", persist_result=False, log_prints=False)
async def feed_batch(request: FeedRequest) -> dict[str, int]:
    """Create the runs of a batch's videos, a limited number at a time, until all have ended; may be started again."""
    store = ArtifactStore(request.store)
    async with get_client() as client:
        queue = Queue(client, store.url, request.batch)
        await queue.adopt(flow_run.id)
        await _check_crashes(queue)
        show = Progress(request.batch)
        limits = request.outstanding, request.tries, request.poll_s, request.pending_s
        feeder = Feeder(store, queue, *limits, get_run_logger(), show)
        await feeder.reconcile()
        chosen = request.chosen(feeder.status()) if request.selects else None
        if chosen and is_cancelled(store, request.batch):
            resume_batch(store, request.batch)
        ended = await feeder.feed(chosen)
        await acreate_table_artifact(_rows(feeder.status()), key="batch", description=f"how {request.batch} ended")
    return dict(ended)


async def _check_crashes(queue: Queue) -> None:
    """End a chain of feeders that crash, each of which has the next one as its successor (`flows.serve.install`)."""
    crashed = await queue.count_crashed_feeders(datetime.now(UTC) - CRASHES_WITHIN)
    if crashed > MOST_CRASHES:
        raise QueueError(
            f"expected at most {MOST_CRASHES} feeders of batch {queue.batch} to crash within {CRASHES_WITHIN}, got "
            f"{crashed}: see the workers' logs, then submit the list again"
        )


class Progress:
    """Moves the progress artifact of the feeder's run page."""

    def __init__(self, batch: str) -> None:
        self._batch = batch
        self._artifact: UUID | None = None
        self._last = 0.0

    async def __call__(self, done: int, total: int) -> None:
        """Show how many videos have ended, at most every `UPDATE_S` seconds."""
        if time.monotonic() - self._last < UPDATE_S and done < total:
            return
        self._last, percent = time.monotonic(), 100.0 * done / max(total, 1)
        if self._artifact is None:
            made = await acreate_progress_artifact(percent, key="batch-progress", description=f"batch {self._batch}")
            self._artifact = made if isinstance(made, UUID) else UUID(str(made))
        else:
            await aupdate_progress_artifact(self._artifact, percent)


def _rows(status: BatchStatus) -> list[dict[str, Any]]:
    states = [{"what": state, "videos": count, "example": ""} for state, count in status.videos.items() if count]
    errors = [
        {"what": group.error_class, "videos": group.count, "example": f"{group.example_video}: {group.example_message}"}
        for group in status.errors
    ]
    return states + errors
