"""The Prefect flow of one video: the same stages as `ahoy run`, each a task that can be watched and retried.

The store, not Prefect, knows what is done: tasks keep no results and no cache, and hand on references only. So a run
that is retried, from the command line or with the button in Prefect's pages, goes on at the stage that failed.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from typing import Any

from prefect import Flow, State, flow, task
from prefect.cache_policies import NO_CACHE
from prefect.concurrency.sync import concurrency
from prefect.exceptions import TerminationSignal
from prefect.runtime import flow_run
from prefect.states import Cancelled
from prefect.tasks import exponential_backoff

from flows.attempt_rows import SEQUENCE_STEP, AttemptRows
from flows.deliver import deliver
from flows.pipeline import process
from flows.prefect_observer import PrefectObserver
from flows.request import VideoRequest
from flows.subjects import each_subject
from storage_schema.artifacts import ARTIFACTS, Blob
from storage_schema.batches import is_cancelled
from tasks.errors import is_transient
from tasks.running import run_stage
from tasks.settings import Settings
from tasks.sources import parse_source, policy_from_environment, source_name
from tasks.stage import Run, Source, Stage, StageRef
from tasks.stages import STAGES

RETRIES, FIRST_DELAY_S, JITTER = 3, 2, 0.5
SLOT_LEASE_S = 60.0  # a killed run's slot is free again after this


class BatchCancelledError(Exception):
    """The batch was cancelled while this video was at work."""


@dataclass
class Caller:
    """Runs stages as Prefect tasks, and knows where it is.

    Attributes:
        timeout_s: seconds that one stage may take.
        rows: told of each stage that begins.
        stage: the one at work, or the last one.
    """

    timeout_s: float
    rows: AttemptRows | None = field(default=None, init=False)
    stage: str = field(default="source", init=False)

    def __call__(self, stage: Stage, settings: Settings, inputs: Mapping[str, StageRef | Source], run: Run) -> StageRef:
        """Run a stage as a Prefect task named after it; of a mapped stage, each item is a task of its own."""
        self._enter(stage.name)
        if is_cancelled(run.store, run.batch):
            raise BatchCancelledError(f"batch {run.batch} was cancelled before {stage.title}")

        def body() -> dict[str, Any]:
            return run_stage(stage, getattr(settings, stage.name), inputs, run).to_json()

        return StageRef.from_json(self._as_task(stage.title, run.video_id)(body)())

    def source(self, request: VideoRequest) -> Source:
        """Bring the video here; a task, so that waiting for it and trying again are seen."""
        self._enter("source")

        def body() -> Source:
            with take_slots(("download",) if _is_remote(request) else ()):
                return request.source()

        source: Source = self._as_task("source", request.video_id or source_name(request.video))(body)()
        return source

    def _enter(self, stage: str) -> None:
        self.stage = stage
        if self.rows is not None:
            self.rows.at(stage)

    def _as_task(self, name: str, video: str) -> Any:
        return task(
            name=name,
            task_run_name=f"{name} {video}",
            cache_policy=NO_CACHE,
            persist_result=False,
            timeout_seconds=self.timeout_s,
            retries=RETRIES,
            retry_delay_seconds=exponential_backoff(FIRST_DELAY_S),
            retry_jitter_factor=JITTER,
            retry_condition_fn=_may_pass,
        )


def take_slots(names: Sequence[str]) -> AbstractContextManager[Any]:
    """Wait for a slot of each named limit of the server; a limit that is not installed limits nothing."""
    if not names:
        return nullcontext()
    return concurrency(list(names), lease_duration=SLOT_LEASE_S, raise_on_lease_renewal_failure=False)


def run_video(
    request: VideoRequest, stages: Sequence[Stage] = STAGES, artifacts: Mapping[str, Sequence[Blob]] = ARTIFACTS
) -> dict[str, str] | State:
    """What the flow does, with these stages.

    Returns:
        Paths of what it made by name, or the state Cancelled.
    """
    call, observer = Caller(request.stage_timeout_s), PrefectObserver()
    # A batch knows the video's id beforehand, so that a source that cannot be had is filed under it.
    source = None if request.video_id else call.source(request)
    video_id = request.id_of(source) if source else str(request.video_id)
    first = (max(flow_run.run_count or 1, 1) - 1) * SEQUENCE_STEP
    run = replace(
        request.run(video_id, observer, request.open_store(artifacts)),
        sequence=itertools.count(first),
        take_slots=take_slots,
    )
    call.rows = rows = AttemptRows(run, flow_run.id)
    try:
        source = source or call.source(request)
        paths: dict[str, str] = {}
        for prefix, settings, own in each_subject(request.subject, source, request.settings(), run, call):
            outcome = process(source, settings, own, only=request.stages, call=call, stages=stages)
            made = deliver(outcome, own, request.out) if request.out else {}
            paths |= {prefix + name: str(path) for name, path in made.items()}
            observer.summary(outcome, own)
    except BatchCancelledError as error:
        rows.ended("cancelled", call.stage, error)
        return Cancelled(message=str(error))
    except Exception as error:
        rows.ended("failed", call.stage, error)
        raise
    except TerminationSignal as error:
        rows.ended("cancelled" if is_cancelled(run.store, run.batch) else "crashed", call.stage, error)
        raise
    rows.ended("done", call.stage)
    return paths


def as_flow(stages: Sequence[Stage], artifacts: Mapping[str, Sequence[Blob]]) -> Flow[[VideoRequest], Any]:
    """Return the flow `process-video` over these stages."""

    @flow(
        name="process-video", flow_run_name=_run_name, persist_result=False, log_prints=False, validate_parameters=True
    )
    def process_video(request: VideoRequest) -> Any:
        """Turn one video into an avatar; returns the paths of what it made."""
        return run_video(request, stages, artifacts)

    return process_video


def _run_name() -> str:
    """The video's short name and the attempt, without anything secret or misleading: what a person looks for."""
    request = VideoRequest.model_validate(flow_run.parameters["request"])
    again = (flow_run.run_count or 1) - 1
    name = f"{request.video_id or source_name(request.video)} #{request.attempt}"
    return f"{name} (retry {again})" if again > 0 else name


def _is_remote(request: VideoRequest) -> bool:
    return parse_source(request.video, policy_from_environment()).kind != "local"


def _may_pass(task: Any, task_run: Any, state: State) -> bool:
    """Whether a failed stage is tried again: by the class of its error alone; a stage that took too long is not."""
    if state.name == "TimedOut":
        return False
    error = state.result(raise_on_failure=False)
    return isinstance(error, BaseException) and is_transient(error)


process_video = as_flow(STAGES, ARTIFACTS)
