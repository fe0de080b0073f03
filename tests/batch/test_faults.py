"""Everything that can be killed is killed in mid-stage; each test counts what was lost: nothing, and nothing twice."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil
import pytest
from prefect.client.orchestration import get_client
from prefect.states import Crashed

from flows.serve.postgres import Postgres
from tests.batch.conftest import Server, kill, wait_for
from tests.batch.driver import Batch

Workers = Callable[[int], subprocess.Popen[Any]]
ONCE = {"ingest": 1, "perceive": 1, "texture": 1}


def _at(batch: Batch, name: str, stage: str = "perceive") -> int:
    """Wait until a video is at a stage; returns its process."""
    pid: int = wait_for(lambda: batch.toys[name].pid(stage), f"{name} to come to {stage}")
    return pid


def _running(server: Server, batch: Batch) -> Any:
    return next(run for run in server.runs(batch.name) if run.state_name == "Running")


def test_a_killed_run_is_made_again_from_the_stage_it_was_at(server: Server, workers: Workers, tmp_path: Path) -> None:
    batch = Batch(tmp_path, {"one": {"perceive": ["die"]}})
    workers(2)
    batch.submit()
    batch.wait_ended()
    toy = batch.toys["one"]
    assert toy.count("made") == ONCE and toy.count("start") == {**ONCE, "perceive": 2}
    lives = [(1, "crashed"), (1, "running"), (1, "scheduled"), (2, "done"), (2, "running"), (2, "scheduled")]
    assert batch.attempts("one") == lives
    running = [row for row in batch.rows("attempts") if (row["attempt_number"], row["state"]) == (1, "running")]
    assert [row["stage"] for row in running] == ["source", "ingest", "perceive"]


def test_the_run_of_a_killed_worker_goes_on_to_its_end(server: Server, workers: Workers, tmp_path: Path) -> None:
    batch = Batch(tmp_path, {"one": {"perceive": ["hold"]}})
    worker = workers(2)
    batch.submit()
    _at(batch, "one")
    worker.kill()
    batch.toys["one"].release()
    batch.wait_ended()
    assert batch.toys["one"].count("start") == ONCE and batch.states() == {"done": 1}


def test_a_run_that_died_with_its_worker_is_found_by_its_silence_and_made_again(
    server: Server, workers: Workers, tmp_path: Path
) -> None:
    batch = Batch(tmp_path, {"one": {"perceive": ["hold", "ok"]}})
    worker = workers(2)
    batch.submit()
    pid = _at(batch, "one")
    worker.kill()
    kill(pid)  # the feeder, which is a process of its own, lives on
    workers(2)
    batch.wait_ended()
    toy = batch.toys["one"]
    assert toy.count("made") == ONCE and toy.count("start") == {**ONCE, "perceive": 2}
    assert "no heartbeat" in next(row["error_message"] for row in batch.rows("attempts") if row["state"] == "crashed")


def test_a_killed_server_comes_back_and_nothing_is_made_twice(server: Server, workers: Workers, tmp_path: Path) -> None:
    batch = Batch(tmp_path, {"one": {"perceive": ["hold"]}, "two": {}, "three": {}})
    workers(1)
    batch.submit()
    _at(batch, "one")
    pid = server.prefect_pid()
    kill(pid)
    wait_for(lambda: server.prefect_pid() != pid and server.answers(), "the server to be back")
    batch.toys["one"].release()
    batch.wait_ended()
    assert batch.states() == {"done": 3}
    assert all(toy.count("made") == ONCE for toy in batch.toys.values())


@pytest.mark.parametrize("how", ["stopped", "killed"])
def test_postgres_comes_back_and_nothing_is_made_twice(
    server: Server, workers: Workers, tmp_path: Path, how: str
) -> None:
    batch = Batch(tmp_path, {"one": {"perceive": ["hold"]}, "two": {}})
    workers(2)
    batch.submit()
    _at(batch, "one")
    before = Postgres(server.place.database).pid()
    assert before is not None
    if how == "stopped":
        # What pg_ctl's fast stop sends; pg_ctl itself would wait for a file that the supervisor has written anew.
        os.kill(before, signal.SIGINT)
    else:
        kill(before)
    wait_for(lambda: Postgres(server.place.database).pid() not in (None, before), "another Postgres")
    wait_for(server.answers, "the server to be back")
    batch.toys["one"].release()
    batch.wait_ended()
    assert batch.states() == {"done": 2}
    assert all(toy.count("made") == ONCE for toy in batch.toys.values())


def test_a_worker_told_to_stop_hands_its_video_over(server: Server, workers: Workers, tmp_path: Path) -> None:
    batch = Batch(tmp_path, {"one": {"perceive": ["hold", "ok"]}})
    worker = workers(2)
    batch.submit()
    _at(batch, "one")
    worker.send_signal(signal.SIGTERM)
    assert worker.wait(60) == 0
    said = [row for row in batch.rows("attempts") if row["state"] == "crashed"]
    assert [row["error_class"] for row in said] == ["TerminationSignal"], "the run itself said so"
    workers(2)
    wait_for(lambda: batch.states() == {"done": 1}, "another worker to make it")
    toy = batch.toys["one"]
    assert toy.count("made") == ONCE and toy.count("start") == {**ONCE, "perceive": 2}


def test_an_orphan_and_its_rerun_make_one_artifact(server: Server, workers: Workers, tmp_path: Path) -> None:
    batch = Batch(tmp_path, {"one": {"perceive": ["hold"]}})
    workers(2)
    batch.submit()
    orphan = _at(batch, "one")
    with get_client(sync_client=True) as client:  # somebody believes that it is dead
        client.set_flow_run_state(_running(server, batch).id, Crashed(message="taken for dead"), force=True)
    wait_for(lambda: (2, "running") in batch.attempts("one"), "the second attempt")
    time.sleep(1.0)  # it waits for the lease of the first
    assert psutil.pid_exists(orphan)
    batch.toys["one"].release()
    batch.wait_ended()
    wait_for(lambda: (2, "done") in batch.attempts("one"), "the second attempt's end")
    assert batch.toys["one"].count("start") == ONCE and batch.toys["one"].count("made") == ONCE
    assert len(list((batch.store.backend.root / "artifacts" / "perceive").iterdir())) == 1


def test_a_killed_feeder_is_replaced_and_creates_nothing_twice(
    server: Server, workers: Workers, tmp_path: Path
) -> None:
    batch = Batch(tmp_path, {"one": {"perceive": ["hold"]}, **{name: {} for name in ("two", "three", "four")}})
    workers(1)
    batch.submit("--outstanding", "1")
    _at(batch, "one")
    first = server.live_feeders(batch.name)[0].id
    kill(server.feeder_pid(batch.name))
    wait_for(lambda: {run.id for run in server.live_feeders(batch.name)} - {first}, "its successor")
    batch.toys["one"].release()
    batch.wait_ended()
    assert batch.states() == {"done": 4} and len(server.runs(batch.name)) == 4
    assert all(toy.count("start") == ONCE for toy in batch.toys.values())


def test_the_successor_of_a_feeder_finishes_the_rerun_that_it_was_asked_for(
    server: Server, workers: Workers, tmp_path: Path
) -> None:
    batch = Batch(tmp_path, {"one": {"perceive": ["bad", "hold"]}, "two": {"perceive": ["bad"]}, "three": {}})
    workers(1)
    batch.submit()
    batch.wait_ended()
    assert batch.states() == {"done": 1, "failed": 2}
    batch.rerun("--failed", "--outstanding", "1")
    wait_for(lambda: batch.toys["one"].count("start")["perceive"] == 2, "the rerun of one")
    kill(server.feeder_pid(batch.name))
    batch.toys["one"].release()
    batch.wait_ended()
    assert batch.states() == {"done": 3} and len(server.runs(batch.name)) == 5
    assert all(toy.count("made") == ONCE for toy in batch.toys.values())


def test_four_workers_share_a_batch(server: Server, workers: Workers, tmp_path: Path) -> None:
    batch = Batch(tmp_path, {f"v{i}": {} for i in range(8)})
    for _ in range(4):
        workers(1)
    batch.submit()
    batch.wait_ended()
    assert batch.states() == {"done": 8} and len(server.runs(batch.name)) == 8
    assert all(toy.count("start") == ONCE for toy in batch.toys.values())


def test_cancelling_stops_what_runs_and_what_waits_and_a_rerun_goes_on(
    server: Server, workers: Workers, tmp_path: Path
) -> None:
    batch = Batch(tmp_path, {"one": {"perceive": ["hold", "ok"]}, "two": {}, "three": {}})
    workers(1)
    batch.submit("--outstanding", "2")
    pid = _at(batch, "one")
    batch.ahoy("cancel", batch.name)
    wait_for(lambda: not os.path.exists(f"/proc/{pid}"), "the run to be stopped")  # noqa: PTH110
    wait_for(lambda: all(seen.state == "cancelled" for seen in server.seen(batch.name)), "its runs to be cancelled")
    assert batch.states() == {"cancelled": 3}
    started = {name: toy.count("start") for name, toy in batch.toys.items()}
    assert started == {"one": {"ingest": 1, "perceive": 1}, "two": {}, "three": {}}
    assert "cancelled" in batch.submit().output
    batch.ahoy("rerun", batch.name, "--poll", "0.3")
    # Until the new feeder announces them, the videos count as cancelled, which is ended as well.
    wait_for(lambda: "cancelled" not in batch.states(), "the rerun to begin")
    batch.wait_ended()
    assert batch.states() == {"done": 3} and all(toy.count("made") == ONCE for toy in batch.toys.values())
