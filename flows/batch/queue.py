"""Flow runs of one batch in Prefect: listed in pages, created under keys, marked and cancelled."""

from __future__ import annotations

import asyncio
import hashlib
from collections.abc import AsyncIterator, Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any
from uuid import UUID

from prefect.client.orchestration import PrefectClient
from prefect.client.schemas.filters import (
    FlowFilter,
    FlowFilterName,
    FlowRunFilter,
    FlowRunFilterId,
    FlowRunFilterStartTime,
    FlowRunFilterState,
    FlowRunFilterStateType,
    FlowRunFilterTags,
)
from prefect.client.schemas.objects import TERMINAL_STATES, FlowRun, StateType
from prefect.client.schemas.sorting import FlowRunSort
from prefect.states import Cancelling, Crashed

from flows.batch.plan import RunState, SeenRun, Work
from flows.serve.install import DEPLOYMENT, FEED_BATCH, PROCESS_VIDEO

PAGE = 200  # the most that Prefect lists at a time
AT_ONCE = 50  # runs created by one request; Prefect takes up to 100
SIDE_BY_SIDE = 8  # requests under way when runs are cancelled
_LIVE = [state for state in StateType if state not in TERMINAL_STATES]
_STATES: dict[StateType, RunState] = {
    StateType.COMPLETED: "done",
    StateType.FAILED: "failed",
    StateType.CRASHED: "crashed",
    StateType.CANCELLED: "cancelled",
}


class QueueError(RuntimeError):
    """Prefect's server does not take what the queue asks for."""


@dataclass(frozen=True)
class Queue:
    """The runs of one batch in one store.

    Attributes:
        client: of the server.
        store_url: the store; batches of one name in two stores are two batches.
        batch: the name.
    """

    client: PrefectClient
    store_url: str
    batch: str

    @property
    def tags(self) -> list[str]:
        """What every run of the batch is tagged with."""
        return [f"batch:{self.batch}", f"store:{self._store_id}"]

    @property
    def _store_id(self) -> str:
        return hashlib.sha256(self.store_url.encode()).hexdigest()[:8]

    async def deployment(self, flow: str) -> UUID:
        """Id of the deployment of a flow.

        Raises:
            ObjectNotFound: nothing is installed in this server.
        """
        return (await self.client.read_deployment_by_name(f"{flow}/{DEPLOYMENT}")).id

    async def runs(self, flow: str = PROCESS_VIDEO, live: bool = False) -> AsyncIterator[FlowRun]:
        """All runs of a flow in this batch, page by page.

        Args:
            flow: its name.
            live: only those that have not ended.
        """
        offset = 0
        while True:
            page = await self.client.read_flow_runs(
                flow_filter=FlowFilter(name=FlowFilterName(any_=[flow])),
                flow_run_filter=self._filter(_LIVE if live else None),
                sort=FlowRunSort.ID_DESC,
                limit=PAGE,
                offset=offset,
            )
            for run in page:
                yield run
            if len(page) < PAGE:
                return
            offset += PAGE

    async def seen(self) -> list[SeenRun]:
        """Every run of a video."""
        return [seen async for run in self.runs() if (seen := seen_run(run)) is not None]

    async def read(self, ids: Iterable[str]) -> list[FlowRun]:
        """Runs by id; those that were deleted are missing."""
        wanted, found = list(ids), []
        for start in range(0, len(wanted), PAGE):
            chunk = [UUID(one) for one in wanted[start : start + PAGE]]
            found += await self.client.read_flow_runs(flow_run_filter=FlowRunFilter(id=FlowRunFilterId(any_=chunk)))
        return found

    async def count_live(self) -> int:
        """How many runs of videos have not ended, whoever created them."""
        return await self.client.count_flow_runs(
            flow_filter=FlowFilter(name=FlowFilterName(any_=[PROCESS_VIDEO])), flow_run_filter=self._filter(_LIVE)
        )

    async def count_crashed_feeders(self, since: datetime) -> int:
        """How many feeders of the batch that began after a time have crashed."""
        crashed = self._filter([StateType.CRASHED], FlowRunFilterStartTime(after_=since))
        return await self.client.count_flow_runs(
            flow_filter=FlowFilter(name=FlowFilterName(any_=[FEED_BATCH])), flow_run_filter=crashed
        )

    async def create(self, work: Sequence[Work], parameters: Sequence[dict[str, Any]]) -> list[str]:
        """Create the runs of these tries, many to a request.

        Args:
            work: the tries.
            parameters: of each, the fields of a `VideoRequest`.

        Returns:
            Ids of the runs; one that existed already is named instead of doubled.

        Raises:
            QueueError: the server refused one, since its parameters do not fit the deployment.
        """
        deployment = await self.deployment(PROCESS_VIDEO)
        ids: list[str] = []
        for start in range(0, len(work), AT_ONCE):
            pairs = zip(work[start : start + AT_ONCE], parameters[start : start + AT_ONCE], strict=True)
            answer = await self.client.request(
                "POST",
                "/deployments/{id}/create_flow_run/bulk",  # type: ignore[arg-type]
                path_params={"id": deployment},
                json=[self._run(item, request) for item, request in pairs],
            )
            for result in answer.json()["results"]:
                if result["status"] != "CREATED":
                    raise QueueError(f"the server refused a run: {result['error']}; run `ahoy install` once more")
                ids.append(result["flow_run_id"])
        return ids

    def _run(self, item: Work, request: dict[str, Any]) -> dict[str, Any]:
        return {
            "parameters": {"request": request},
            "name": f"{item.video_id} #{item.attempt}",
            "tags": [*self.tags, f"video:{item.video_id}"],
            "state": {"type": "SCHEDULED"},
            # Checked when the list was submitted and again when the run starts; here it would take half of the time.
            "enforce_parameter_schema": False,
            # Without the attempt in it a rerun would silently get the finished run back.
            "idempotency_key": f"{self._store_id}/{self.batch}/{item.video_id}/{item.attempt}",
        }

    async def start_feeder(self, request: dict[str, Any]) -> FlowRun:
        """Create a run of `feed-batch`."""
        deployment = await self.deployment(FEED_BATCH)
        return await self.client.create_flow_run_from_deployment(
            deployment, parameters={"request": request}, name=f"feed {self.batch}", tags=self.tags
        )

    async def adopt(self, flow_run_id: str) -> None:
        """Tag a run as one of the batch, however it was started."""
        run = await self.client.read_flow_run(UUID(flow_run_id))
        await self.client.update_flow_run(run.id, tags={*run.tags, *self.tags})

    async def mark_crashed(self, run: FlowRun, why: str) -> None:
        """Say that a run is dead that cannot say so itself."""
        await self.client.set_flow_run_state(run.id, Crashed(message=why), force=True)

    async def cancel(self, runs: Sequence[FlowRun]) -> None:
        """Stop runs: those that have not started are cancelled at once, those at work by their workers."""
        gate = asyncio.Semaphore(SIDE_BY_SIDE)

        async def one(run: FlowRun) -> None:
            async with gate:
                await self.client.set_flow_run_state(run.id, Cancelling(message="the batch was cancelled"))

        await asyncio.gather(*map(one, runs))

    def _filter(
        self, states: list[StateType] | None, start_time: FlowRunFilterStartTime | None = None
    ) -> FlowRunFilter:
        """The batch's runs in these states (None: in any) that began so."""
        state = FlowRunFilterState(type=FlowRunFilterStateType(any_=states)) if states else None
        return FlowRunFilter(tags=FlowRunFilterTags(all_=self.tags), state=state, start_time=start_time)


def seen_run(run: FlowRun) -> SeenRun | None:
    """What the plan needs of a run; None for one that was not created by a feeder."""
    request = run.parameters.get("request")
    if not isinstance(request, dict) or not request.get("video_id"):
        return None
    return SeenRun(request["video_id"], int(request.get("attempt", 1)), run_state(run), str(run.id))


def run_state(run: FlowRun) -> RunState:
    """Prefect's state in five words."""
    return _STATES.get(run.state_type, "live") if run.state_type else "live"
