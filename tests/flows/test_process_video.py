"""The Prefect flow: the same stages on a real (temporary) server, tracked, with pictures and progress."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from prefect.client.orchestration import get_client
from prefect.client.schemas.objects import FlowRun, StateType
from prefect.testing.utilities import prefect_test_harness

from flows.evaluate import evaluate_flow
from flows.evaluate_request import EvaluateRequest
from flows.process_video import process_video
from flows.request import VideoRequest
from tests.e2e.conftest import SMALL, SmallRun, demo_clip, models, small_run  # noqa: F401  (session fixtures)

STAGES = {"ingest", "perceive", "texture", "coarse", "avatar", "animate", "report"}


@pytest.fixture(scope="session")
def server() -> Iterator[None]:
    with prefect_test_harness(server_startup_timeout=120):
        yield


@pytest.fixture(scope="session")
def flow_run(server: None, small_run: SmallRun) -> tuple[dict[str, str], FlowRun]:  # noqa: F811
    """The flow over the store of the small run, one stage made anew so that progress and bill are real."""
    knobs = (*SMALL, "animate.turntable_frames=9")
    request = VideoRequest(video=str(small_run.clip), out=str(small_run.out), overrides=knobs, batch="prefect")
    paths = process_video(request)
    with get_client(sync_client=True) as client:
        runs = client.read_flow_runs()
    return paths, max(runs, key=lambda run: run.created)


def test_the_flow_completes_with_a_task_per_stage(flow_run: tuple[dict[str, str], FlowRun]) -> None:
    paths, run = flow_run
    assert run.state is not None and run.state.type == StateType.COMPLETED and run.name == "demo #1"
    with get_client(sync_client=True) as client:
        tasks = client.read_task_runs()
    mine = {task.name.split()[0] for task in tasks if task.flow_run_id == run.id}
    assert mine == STAGES | {"source"} and "report.html" in paths


def test_the_run_page_shows_bills_pictures_and_progress(flow_run: tuple[dict[str, str], FlowRun]) -> None:
    _, run = flow_run
    with get_client(sync_client=True) as client:
        artifacts = {a.key: a for a in client.read_artifacts() if a.flow_run_id == run.id}
    assert "data:image/jpeg;base64," in artifacts["stage-animate"].data and "done" in artifacts["stage-animate"].data
    assert "stage-texture" not in artifacts, "found in the store: the table of the run says so"
    assert "found in the store" in artifacts["time-per-stage"].data
    assert artifacts["progress-animate"].data == 100.0


def test_a_failed_stage_fails_the_flow_with_its_own_error(server: None, tmp_path) -> None:  # type: ignore[no-untyped-def]
    note = tmp_path / "note.mp4"
    note.write_text("not a video")
    with pytest.raises(ValueError, match=r"note\.mp4"):
        process_video(VideoRequest(video=str(note), out=str(tmp_path / "out")))


def test_an_evaluation_is_a_flow_with_a_task_a_cell(server: None, small_run: SmallRun) -> None:  # noqa: F811
    request = EvaluateRequest(
        dataset=str(small_run.clip),
        out=str(small_run.out / "flow-scores"),
        store=str(small_run.out / "store"),
        ablate=("A",),
        protocols=("held-out-frame",),
        withhold=2,
        overrides=SMALL,
    )
    paths = evaluate_flow(request)
    assert "held-out-frame" in Path(paths["table.md"]).read_text()
    with get_client(sync_client=True) as client:
        (run,) = [run for run in client.read_flow_runs() if client.read_flow(run.flow_id).name == "evaluate"]
        names = {task.name for task in client.read_task_runs() if task.flow_run_id == run.id}
    assert run.state is not None and run.state.type == StateType.COMPLETED
    assert {"demo A", "demo reference: shifted 2 px", "demo reference: flat colour"} <= names
