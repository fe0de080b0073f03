"""One batch of good and bad videos, submitted, watched and rerun, on a real server with a real worker."""

from __future__ import annotations

import asyncio
import json
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from prefect.client.orchestration import get_client
from prefect.client.schemas.filters import FlowRunFilter, FlowRunFilterId
from prefect.client.schemas.objects import FlowRun
from prefect.states import Scheduled

from flows.batch.plan import Work
from flows.batch.queue import PAGE, Queue, seen_run
from tests.batch.conftest import Server, wait_for
from tests.batch.driver import Batch

Workers = Callable[[int], subprocess.Popen[Any]]
ONCE = {"ingest": 1, "perceive": 1, "texture": 1}
VIDEOS = {
    "good": {},
    "fine": {},
    "bad": {"perceive": ["bad", "bad", "bad"]},
    "defect": {"texture": ["bug", "ok"]},
    "button": {"perceive": ["bug", "ok"]},
    "lost": {"perceive": ["break", "ok"]},
    "poison": {"perceive": ["crash"] * 9},
}


@pytest.fixture(scope="module")
def batch(server: Server, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Batch]:
    """The batch after its first pass; tests below go on from what those above left."""
    made = Batch(tmp_path_factory.mktemp("mixed"), VIDEOS)
    server.worker(2)
    made.submit("--tries", "2")
    twice = made.submit("--tries", "2")
    assert "submitted before" in twice.output and "feeding it already" in twice.output
    made.wait_ended()
    yield made
    server.stop_workers()


def _run(server: Server, batch: Batch, name: str) -> FlowRun:
    """The latest run of a video."""
    runs = [run for run in server.runs(batch.name) if run.parameters["request"]["video_id"].startswith(f"{name}-")]
    return max(runs, key=lambda run: run.parameters["request"]["attempt"])


def test_good_videos_are_made_once_beside_bad_ones(batch: Batch) -> None:
    assert batch.states() == {"done": 3, "failed": 3, "crashed": 1}
    for name in ("good", "fine"):
        assert batch.toys[name].count("start") == ONCE and batch.toys[name].count("made") == ONCE


def test_two_submits_of_one_list_are_one_batch(server: Server, batch: Batch) -> None:
    runs = server.runs(batch.name)
    keys = [run.idempotency_key for run in runs]
    assert len(keys) == len(set(keys)) == len(VIDEOS) + 1  # the poisoned one was started twice


def test_bad_input_and_defects_are_not_tried_again(batch: Batch) -> None:
    assert batch.toys["bad"].count("start") == {"ingest": 1, "perceive": 1}
    assert batch.toys["defect"].count("start") == ONCE
    assert (batch.video("bad").error_class, batch.video("bad").stage) == ("BadInputError", "perceive")
    assert (batch.video("defect").error_class, batch.video("defect").stage) == ("RuntimeError", "texture")


def test_a_lost_connection_is_tried_again_within_the_run(server: Server, batch: Batch) -> None:
    assert batch.toys["lost"].count("start") == {**ONCE, "perceive": 2}
    assert batch.video("lost").attempt_number == 1 and _run(server, batch, "lost").state_name == "Completed"


def test_a_video_that_crashes_the_interpreter_is_given_up_and_filed(batch: Batch) -> None:
    assert batch.toys["poison"].count("start") == {"ingest": 1, "perceive": 2}
    video = batch.video("poison")
    assert (video.state, video.attempt_number, video.stage) == ("crashed", 2, "perceive")


def test_runs_say_their_video_their_attempt_and_their_batch(server: Server, batch: Batch) -> None:
    run = _run(server, batch, "poison")
    video_id = batch.video("poison").video_id
    assert run.name == f"{video_id} #2" and {f"batch:{batch.name}", f"video:{video_id}"} <= set(run.tags)


def test_the_run_page_shows_time_per_stage_scores_and_links(server: Server, batch: Batch) -> None:
    run = _run(server, batch, "good")
    with get_client(sync_client=True) as client:
        found = client.read_artifacts(flow_run_filter=FlowRunFilter(id=FlowRunFilterId(any_=[run.id])))
    artifacts = {artifact.key: artifact for artifact in found}
    assert {row["stage"] for row in json.loads(artifacts["time-per-stage"].data)} == set(ONCE)
    assert json.loads(artifacts["scores"].data)[0]["value"] == "good"


def test_status_shows_counts_and_errors_with_an_example(batch: Batch) -> None:
    shown = batch.ahoy("status", batch.name).output
    assert "3 done" in shown and "BadInputError" in shown and batch.video("bad").video_id in shown.replace("\n", "")
    told = json.loads(batch.ahoy("status", batch.name, "--json").output)
    assert told["videos"]["failed"] == 3 and len(told["records"]) == len(VIDEOS)


def test_logs_are_those_of_the_video_asked_for(batch: Batch) -> None:
    shown = batch.ahoy("logs", batch.name, "--video", batch.video("defect").video_id).output
    assert "a defect of ours" in shown and "give another" not in shown
    # The last line is logged as the process ends, within the interval in which Prefect sends its batches.
    ended = batch.ahoy("logs", batch.name, "--video", batch.video("good").video_id).output
    assert "Finished in state Completed" in ended.splitlines()[-1] and len(ended.splitlines()) > len(ONCE) * 2


def test_the_retry_button_goes_on_at_the_failed_stage(server: Server, batch: Batch) -> None:
    run = _run(server, batch, "button")
    with get_client(sync_client=True) as client:  # what the button sends
        client.set_flow_run_state(run.id, Scheduled(name="AwaitingRetry", message="from the UI"))
    wait_for(lambda: batch.video("button").state == "done", "the retried run to be done")
    assert batch.toys["button"].count("made") == ONCE
    assert batch.toys["button"].count("start") == {**ONCE, "perceive": 2}
    wait_for(lambda: _run(server, batch, "button").state_name == "Completed", "the run to be completed")


def test_a_rerun_of_one_error_leaves_all_others_alone(batch: Batch) -> None:
    before = {name: toy.count("start") for name, toy in batch.toys.items()}
    assert "1 videos run again" in batch.rerun("--error", "RuntimeError")
    wait_for(lambda: batch.video("defect").state == "done", "the rerun video to be done")
    after = {name: toy.count("start") for name, toy in batch.toys.items()}
    assert {name for name in after if after[name] != before[name]} == {"defect"}
    assert after["defect"] == {**ONCE, "texture": 2}, "a finished stage was made again"


def test_a_rerun_of_what_failed_takes_the_failed_alone(batch: Batch) -> None:
    before = {name: toy.count("start") for name, toy in batch.toys.items()}
    assert "1 videos run again" in batch.rerun("--failed")
    wait_for(lambda: (2, "failed") in batch.attempts("bad"), "the second failure")
    after = {name: toy.count("start") for name, toy in batch.toys.items()}
    assert {name for name in after if after[name] != before[name]} == {"bad"}
    assert after["bad"] == {"ingest": 1, "perceive": 2}


def test_a_stage_or_video_that_is_not_there_is_refused_with_those_that_are(batch: Batch) -> None:
    assert "perceive" in batch.ahoy("rerun", batch.name, "--stage", "percieve", code=2).output
    assert "goodd" in batch.ahoy("rerun", batch.name, "--video", "goodd", code=2).output


def test_resubmitting_a_finished_batch_does_nothing_and_says_so(server: Server, tmp_path: Path) -> None:
    made = Batch(tmp_path, {"only": {"ingest": ["bad"]}})
    server.worker(1)
    made.submit()
    made.wait_ended()
    wait_for(lambda: not server.live_feeders(made.name), "the feeder to end")
    said = made.submit().output
    assert "nothing to do" in said and "rerun" in said
    assert len(server.runs(made.name)) == 1 and made.toys["only"].count("start") == {"ingest": 1}


def test_slots_are_held_by_the_stages_that_say_so_and_no_others(server: Server, tmp_path: Path) -> None:
    both = {"perceive": ["hold"], "texture": ["nap"]}
    made = Batch(tmp_path, {"a": both, "b": both})
    server.worker(2)
    made.submit()
    wait_for(lambda: all(toy.pid("perceive") for toy in made.toys.values()), "both at perceive")
    assert _slots("gpu") == 0
    for toy in made.toys.values():
        toy.release()
    made.wait_ended()
    spans = sorted(line[3] for toy in made.toys.values() for line in toy.lines() if line[0] == "texture")
    whose = {line[3]: line[2] for toy in made.toys.values() for line in toy.lines() if line[0] == "texture"}
    assert [whose[at] for at in spans[:2]] == [whose[spans[0]]] * 2, "both held the one slot at a time"


def _slots(name: str) -> int:
    with get_client(sync_client=True) as client:
        return client.read_global_concurrency_limit_by_name(name).active_slots


def test_more_runs_than_a_page_are_listed(server: Server, tmp_path: Path) -> None:
    server.stop_workers()  # these runs are there to be listed
    number = PAGE + 5

    async def create() -> tuple[int, int]:
        async with get_client() as client:
            queue = Queue(client, (tmp_path / "store").as_uri(), "many")
            work = [Work(f"v{i}", 1) for i in range(number)]
            requests = [{"video": "x", "video_id": w.video_id, "store": "x", "attempt": 1} for w in work]
            await queue.create(work, requests)
            await queue.create(work[:10], requests[:10])
            listed = {seen.video_id async for run in queue.runs(live=True) if (seen := seen_run(run))}
            count = await queue.count_live()
            await queue.cancel([run async for run in queue.runs(live=True)])
            return len(listed), count

    assert asyncio.run(create()) == (number, number)


def test_the_password_is_in_no_log_and_no_manifest(server: Server, batch: Batch) -> None:
    password = server.place.secret().split(":", 1)[1]
    files = [*server.place.logs.rglob("*"), *batch.store.backend.root.rglob("*")]
    assert len(files) > 20
    assert [path for path in files if path.is_file() and password.encode() in path.read_bytes()] == []
