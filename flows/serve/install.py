"""What Ahoy needs inside Prefect, installed by one call that may be repeated: pool, deployments, limits, automation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import timedelta
from typing import Any

from prefect.client.orchestration import PrefectClient, get_client
from prefect.client.schemas.actions import WorkPoolCreate, WorkPoolUpdate
from prefect.events.actions import ChangeFlowRunState
from prefect.events.schemas.automations import AutomationCore, EventTrigger, Posture
from prefect.exceptions import ObjectNotFound
from prefect.states import StateType
from prefect.utilities.importtools import import_object
from prefect.workers.process import ProcessWorker

POOL = "ahoy"
DEPLOYMENT = "ahoy"
PROCESS_VIDEO, FEED_BATCH = "process-video", "feed-batch"
ENTRYPOINTS: Mapping[str, str] = {
    PROCESS_VIDEO: "flows.process_video.process_video",
    FEED_BATCH: "flows.feed_batch.feed_batch",
}
SILENT_S = 75  # two heartbeats missed, and half of one more for delays; found within 120 s with room to spare
AUTOMATION = "ahoy: runs that fell silent have crashed"
_HEARTBEAT = "prefect.flow-run.heartbeat"


@dataclass(frozen=True)
class Limits:
    """Slots of the named resources, over all workers."""

    gpu: int = 1
    download: int = 4


@dataclass(frozen=True)
class Installation:
    """What is installed.

    Attributes:
        limits: slots.
        entrypoints: flow name -> import path of the flow; both are deployed under the name `ahoy`.
        environment: what the processes of the runs get beside the worker's own environment.
    """

    limits: Limits = Limits()
    entrypoints: Mapping[str, str] = field(default_factory=lambda: ENTRYPOINTS)
    environment: Mapping[str, str] = field(default_factory=dict)


async def install(installation: Installation = Installation()) -> None:
    """Create or update everything in the server that the client's settings name."""
    async with get_client() as client:
        await _pool(client, installation.environment)
        for name, slots in vars(installation.limits).items():
            await client.upsert_global_concurrency_limit_by_name(name, slots)
        for entrypoint in installation.entrypoints.values():
            await _deployment(client, entrypoint)
        await _automation(client)


async def _pool(client: PrefectClient, environment: Mapping[str, str]) -> None:
    template = ProcessWorker.get_default_base_job_template()
    template["variables"]["properties"]["env"]["default"] = dict(environment)
    try:
        await client.read_work_pool(POOL)
    except ObjectNotFound:
        await client.create_work_pool(WorkPoolCreate(name=POOL, type="process", base_job_template=template))
    else:
        await client.update_work_pool(POOL, WorkPoolUpdate(base_job_template=template))


async def _deployment(client: PrefectClient, entrypoint: str) -> None:
    flow: Any = import_object(entrypoint)
    flow_id = await client.create_flow(flow)
    await client.create_deployment(
        flow_id=flow_id,
        name=DEPLOYMENT,
        description=flow.description,
        entrypoint=entrypoint,
        path=None,
        pull_steps=None,
        work_pool_name=POOL,
        parameter_openapi_schema=_schema(flow),
        enforce_parameter_schema=True,
        tags=["ahoy"],
    )


def _schema(flow: Any) -> Any:
    from prefect.utilities.callables import parameter_schema

    return parameter_schema(flow).model_dump(exclude_unset=True)


async def _automation(client: PrefectClient) -> None:
    """Mark runs Crashed that sent a heartbeat and then, without having ended, none for `SILENT_S`."""
    ends = {f"prefect.flow-run.{state}" for state in ("Completed", "Failed", "Cancelled", "Crashed")}
    waits = {f"prefect.flow-run.{state}" for state in ("AwaitingRetry", "Paused", "Suspended", "Scheduled")}
    wanted = AutomationCore(
        name=AUTOMATION,
        description="A worker that dies with its run tells nobody. Ahoy's flows send a heartbeat every 30 s.",
        trigger=EventTrigger(
            posture=Posture.Proactive,
            after={_HEARTBEAT},
            expect={_HEARTBEAT} | ends | waits,
            match={"prefect.resource.id": "prefect.flow-run.*"},  # type: ignore[arg-type]
            for_each={"prefect.resource.id"},
            threshold=1,
            within=timedelta(seconds=SILENT_S),
        ),
        actions=[ChangeFlowRunState(state=StateType.CRASHED, message=f"no heartbeat for {SILENT_S} s")],
    )
    found = await client.read_automations_by_name(AUTOMATION)
    if found:
        await client.update_automation(found[0].id, wanted)
    else:
        await client.create_automation(wanted)
