"""The Prefect flow of one video: the same stages as `ahoy run`, each a task that can be watched and retried.

The store, not Prefect, knows what is done: tasks keep no results and no cache, and hand on references only.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from prefect import flow, task
from prefect.cache_policies import NO_CACHE
from prefect.runtime import flow_run

from flows.deliver import deliver
from flows.pipeline import process
from flows.prefect_observer import PrefectObserver
from flows.request import VideoRequest
from flows.subjects import for_subject, list_people
from tasks.settings import Settings
from tasks.sources import source_name
from tasks.stage import Run, Source, Stage, StageRef, run_stage


def call_as_task(stage: Stage, settings: Settings, inputs: Mapping[str, StageRef | Source], run: Run) -> StageRef:
    """Run a stage as a Prefect task named after it."""

    def body() -> dict[str, Any]:
        return run_stage(stage, getattr(settings, stage.name), inputs, run).to_json()

    as_task = task(
        name=stage.name, cache_policy=NO_CACHE, persist_result=False, task_run_name=f"{stage.name} {run.video_id}"
    )
    return StageRef.from_json(as_task(body)())


def _run_name() -> str:
    """The video's short name, without anything secret or misleading: what a person looks for in a list of runs."""
    request: Any = flow_run.parameters["request"]
    return source_name(request["video"] if isinstance(request, dict) else request.video)


@flow(name="process-video", flow_run_name=_run_name, persist_result=False, log_prints=False)
def process_video(request: VideoRequest) -> dict[str, str]:
    """Turn one video into an avatar; returns the paths of what it made."""
    source = request.source()
    run = request.run(source, PrefectObserver())
    settings = request.settings()
    if request.subject != "all":
        outcome = process(source, settings, run, only=request.stages, call=call_as_task)
        return {name: str(path) for name, path in deliver(outcome, run, request.out).items()}
    made: dict[str, str] = {}
    for number in list_people(source, settings, run, call_as_task).worthwhile:
        chosen, own = for_subject(settings, run, number)
        outcome = process(source, chosen, own, only=request.stages, call=call_as_task)
        made |= {f"person{number}/{name}": str(path) for name, path in deliver(outcome, own, request.out).items()}
    return made
