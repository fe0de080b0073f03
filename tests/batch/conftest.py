"""A real Prefect server on embedded Postgres, real workers, and the toy flow deployed in it: one for the session."""

from __future__ import annotations

import asyncio
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import psutil
import pytest
from prefect.client.orchestration import SyncPrefectClient, get_client
from prefect.client.schemas.filters import FlowRunFilter, FlowRunFilterTags
from prefect.client.schemas.objects import TERMINAL_STATES, FlowRun

from flows.batch.plan import SeenRun
from flows.batch.queue import seen_run
from flows.serve import nursery
from flows.serve.install import ENTRYPOINTS, FEED_BATCH, PROCESS_VIDEO, Installation, install
from flows.serve.place import QUIET, WORKER_SETTINGS, Place, client_environment, connected

ROOT = Path(__file__).resolve().parents[2]
LIMIT_S = 900  # of a test: several processes start in it one after another, and the machine may be busy
READY_S = 240.0  # far more than anything takes; a test that waits so long has failed


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker(pytest.mark.timeout(LIMIT_S))


def wait_for(condition: Callable[[], Any], what: str, limit_s: float = READY_S) -> Any:
    """Wait until something is true and return it."""
    deadline = time.monotonic() + limit_s
    while not (value := condition()):
        assert time.monotonic() < deadline, f"waited {limit_s:.0f} s for {what}"
        time.sleep(0.3)
    return value


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@dataclass
class Server:
    """The running server, and the workers that tests start."""

    place: Place
    port: int
    socket: str
    process: subprocess.Popen[Any] | None = None
    workers: list[subprocess.Popen[Any]] = field(default_factory=list)

    def start(self) -> None:
        options = ["--no-install", "--data", str(self.place.folder), "--port", str(self.port)]
        command = [sys.executable, "-m", "flows", "server", *options]
        self.process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None and self.process.stdout.readline().startswith("Prefect's pages")

    def stop(self) -> None:
        assert self.process is not None
        self.process.terminate()
        assert self.process.wait(60) == 0

    def worker(self, limit: int = 2) -> subprocess.Popen[Any]:
        """Start a worker process; its runs start from the session's nursery."""
        log = (self.place.logs / f"worker-{len(self.workers)}.log").open("wb")
        process = subprocess.Popen(
            [sys.executable, "-m", "flows", "worker", "--limit", str(limit), "--data", str(self.place.folder)],
            env=self.environment(), cwd=ROOT, stdout=log, stderr=log,
        )  # fmt: skip
        self.workers.append(process)
        return process

    def environment(self) -> dict[str, str]:
        own = {"AHOY_SERVER": str(self.place.folder), "AHOY_NURSERY": self.socket, "PYTHONPATH": str(ROOT)}
        return {**os.environ, "PREFECT_WORKER_QUERY_SECONDS": "0.5", **own}

    def stop_workers(self) -> None:
        for process in self.workers:
            process.kill()
            process.wait()
        self.workers.clear()

    def runs(self, batch: str, flow: str = PROCESS_VIDEO) -> list[FlowRun]:
        tags = FlowRunFilterTags(all_=[f"batch:{batch}"])
        with get_client(sync_client=True) as client:
            assert isinstance(client, SyncPrefectClient)
            found = client.read_flow_runs(flow_run_filter=FlowRunFilter(tags=tags))
        names = {"process-video": True, "feed-batch": False}
        return [run for run in found if (seen_run(run) is not None) == names[flow]]

    def live_feeders(self, batch: str) -> list[FlowRun]:
        return [run for run in self.runs(batch, FEED_BATCH) if run.state_type not in TERMINAL_STATES]

    def feeder_pid(self, batch: str) -> int:
        """The process that the worker sees of what feeds a batch; killing it kills the feeder."""
        run = str(wait_for(lambda: self.live_feeders(batch), "a feeder")[0].id)
        return next(p.pid for p in psutil.process_iter() if _environment(p).get("PREFECT__FLOW_RUN_ID") == run)

    def prefect_pid(self) -> int:
        return int((self.place.folder / "prefect.pid").read_text())

    def answers(self) -> bool:
        """Whether the server can read its database."""
        try:
            self.runs("none")
        except Exception:
            return False
        return True

    def seen(self, batch: str) -> list[SeenRun]:
        return [seen for run in self.runs(batch) if (seen := seen_run(run)) is not None]


def _environment(process: psutil.Process) -> dict[str, str]:
    try:
        return process.environ()
    except psutil.Error:
        return {}


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    folder = Path(tempfile.mkdtemp(prefix="ahoy-test-server-"))  # short: sockets have short names
    running = Server(Place(folder), free_port(), str(folder / "nursery"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AHOY_SERVER", str(folder))
        for name in ("PREFECT_API_URL", "PREFECT_API_AUTH_STRING"):
            patch.delenv(name, raising=False)
        running.place.make()
        running.start()
        hatchery = _nursery(running)
        try:
            with connected(running.place):
                entrypoints = {**ENTRYPOINTS, PROCESS_VIDEO: "tests.batch.toy.process_video"}
                asyncio.run(install(Installation(entrypoints=entrypoints)))
                yield running
        finally:
            running.stop_workers()
            assert hatchery.stdin is not None
            hatchery.stdin.close()
            hatchery.kill()
            hatchery.wait()
            running.stop()
            shutil.rmtree(folder)


def _nursery(server: Server) -> subprocess.Popen[bytes]:
    """One for all workers of the session: importing everything takes ten seconds."""
    environment = {**WORKER_SETTINGS, **server.environment(), **QUIET, **client_environment(server.place)}
    log = (server.place.logs / "nursery.log").open("wb")
    process = subprocess.Popen(
        [sys.executable, "-m", nursery.__name__, server.socket],
        env=environment, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, start_new_session=True,
    )  # fmt: skip
    assert process.stdout is not None and process.stdout.readline() == nursery.READY
    return process


@pytest.fixture
def workers(server: Server) -> Iterator[Callable[[int], subprocess.Popen[Any]]]:
    """Starts workers, and ends them after the test."""
    yield server.worker
    server.stop_workers()


def kill(pid: int) -> None:
    os.kill(pid, signal.SIGKILL)
