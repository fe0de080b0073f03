"""What Ahoy needs inside Prefect, installed by one repeatable call: pools, deployments, limits, automations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import timedelta
from typing import Any
from uuid import UUID

from prefect.client.orchestration import PrefectClient, get_client
from prefect.client.schemas.actions import WorkPoolCreate
from prefect.events.actions import ChangeFlowRunState, RunDeployment
from prefect.events.schemas.automations import AutomationCore, EventTrigger, Posture
from prefect.exceptions import ObjectNotFound
from prefect.states import StateType
from prefect.utilities.importtools import import_object
from prefect.workers.process import ProcessWorker

POOL = "ahoy"
FEED_POOL = "ahoy-feed"  # of its own: a feeder that waited behind the videos it has to create would wait for ever
DEPLOYMENT = "ahoy"
PROCESS_VIDEO, FEED_BATCH = "process-video", "feed-batch"
POOLS: Mapping[str, str] = {PROCESS_VIDEO: POOL, FEED_BATCH: FEED_POOL}
ENTRYPOINTS: Mapping[str, str] = {
    PROCESS_VIDEO: "flows.process_video.process_video",
    FEED_BATCH: "flows.feed_batch.feed_batch",
}
SILENT_S = 75  # two heartbeats missed, and half of one more for delays; found within 120 s with room to spare
SILENCE = "ahoy: runs that fell silent have crashed"
SUCCESSION = "ahoy: a feeder that crashed has a successor"
_JOB_VARIABLES = ("env", "working_dir")
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
    """

    limits: Limits = Limits()
    entrypoints: Mapping[str, str] = field(default_factory=lambda: ENTRYPOINTS)


async def install(installation: Installation = Installation()) -> None:
    """Create or update everything in the server that the client's settings name."""
    async with get_client() as client:
        for pool in POOLS.values():
            await _pool(client, pool)
        for name, slots in vars(installation.limits).items():
            await client.upsert_global_concurrency_limit_by_name(name, slots)
        deployments = {
            flow: await _deployment(client, entrypoint, POOLS[flow])
            for flow, entrypoint in installation.entrypoints.items()
        }
        for automation in (_silence(), _succession(deployments[FEED_BATCH])):
            await _automation(client, automation)


async def _pool(client: PrefectClient, name: str) -> None:
    """Create a pool unless it is there: its owner may have given it another type or template."""
    try:
        await client.read_work_pool(name)
    except ObjectNotFound:
        await client.create_work_pool(WorkPoolCreate(name=name, type="process", base_job_template=_job_template()))


def _job_template() -> dict[str, Any]:
    """The process worker's own template, less what our runs never set: the server checks all of it for every run."""
    whole: Any = ProcessWorker.get_default_base_job_template()
    configuration = {name: whole["job_configuration"][name] for name in _JOB_VARIABLES}
    variables = {name: whole["variables"]["properties"][name] for name in _JOB_VARIABLES}
    return {"job_configuration": configuration, "variables": {"type": "object", "properties": variables}}


async def _deployment(client: PrefectClient, entrypoint: str, pool: str) -> UUID:
    flow: Any = import_object(entrypoint)
    flow_id = await client.create_flow(flow)
    return await client.create_deployment(
        flow_id=flow_id,
        name=DEPLOYMENT,
        description=flow.description,
        entrypoint=entrypoint,
        path=None,
        pull_steps=None,
        work_pool_name=pool,
        parameter_openapi_schema=_schema(flow),
        enforce_parameter_schema=True,
        tags=["ahoy"],
    )


def _schema(flow: Any) -> Any:
    from prefect.utilities.callables import parameter_schema

    return parameter_schema(flow).model_dump(exclude_unset=True)


def _silence() -> AutomationCore:
    """Mark runs Crashed that began and then, without having ended, sent no heartbeat for `SILENT_S`."""
    ends = ("Completed", "Failed", "TimedOut", "Cancelled", "Crashed")
    waits = ("AwaitingRetry", "Paused", "Suspended", "Scheduled", "Pending")
    signs = {_HEARTBEAT} | {f"prefect.flow-run.{state}" for state in (*ends, *waits)}
    return AutomationCore(
        name=SILENCE,
        description="A worker that dies with its run tells nobody. Ahoy's flows send a heartbeat every 30 s.",
        trigger=EventTrigger(
            posture=Posture.Proactive,
            after={_HEARTBEAT, "prefect.flow-run.Running"},
            expect=signs,
            match={"prefect.resource.id": "prefect.flow-run.*"},
            match_related={"prefect.resource.role": "flow", "prefect.resource.name": list(POOLS)},
            for_each={"prefect.resource.id"},
            threshold=1,
            within=timedelta(seconds=SILENT_S),
        ),
        actions=[ChangeFlowRunState(state=StateType.CRASHED, message=f"no heartbeat for {SILENT_S} s")],
    )


def _succession(feeder: UUID) -> AutomationCore:
    """Start a feeder in the place of one that crashed, with the same limits.

    It goes on with the batch and selects nothing: what its predecessor was to run again is announced in the ledger.
    """
    goes_on = "dict(flow_run.parameters['request'], rerun='no', stage=none, error=none, videos=[])"
    request = {
        "__prefect_kind": "json",
        "value": {"__prefect_kind": "jinja", "template": "{{ " + goes_on + " | tojson }}"},
    }
    return AutomationCore(
        name=SUCCESSION,
        description="The feeder of a batch dies with its worker; the next worker goes on.",
        trigger=EventTrigger(
            posture=Posture.Reactive,
            expect={"prefect.flow-run.Crashed"},
            match={"prefect.resource.id": "prefect.flow-run.*"},
            match_related={"prefect.resource.role": "flow", "prefect.resource.name": FEED_BATCH},
            for_each={"prefect.resource.id"},
            threshold=1,
            within=timedelta(0),
        ),
        actions=[RunDeployment(source="selected", deployment_id=feeder, parameters={"request": request})],
    )


async def _automation(client: PrefectClient, wanted: AutomationCore) -> None:
    found = await client.read_automations_by_name(wanted.name)
    if found:
        await client.update_automation(found[0].id, wanted)
    else:
        await client.create_automation(wanted)
