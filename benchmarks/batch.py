"""What the queue costs: `python -m benchmarks.batch --json OUT`.

A real server on embedded Postgres, a real worker, real flow runs; only the stages do nothing. Wall times hold for the
machine as busy as it was; the CPU seconds beside them hold for any day.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import psutil
from prefect.client.orchestration import get_client
from prefect.client.schemas.filters import FlowRunFilter, FlowRunFilterId

from ahoy_core.cost.machine import machine
from benchmarks.noop import HOLD, NAMES
from flows.attempt_rows import attempt_row
from flows.batch.plan import Work
from flows.batch.queue import Queue
from flows.batch.requests import video_parameters
from flows.batch.submission import start_feeder
from flows.feed_batch import FeedRequest
from flows.serve.install import ENTRYPOINTS, PROCESS_VIDEO, Installation, install
from flows.serve.place import Place, connected
from storage_schema.batches import BatchEntry, BatchManifest, submit
from storage_schema.status import batch_status
from storage_schema.store import ArtifactStore
from storage_schema.tables import Tables

ROOT = Path(__file__).resolve().parents[1]
SLOTS = 1  # videos at a time: what one video costs; with two, two cores are busy and each video waits for the other
PARTS = ("submit", "overhead", "skip", "status", "dead", "memory")


@dataclass
class Bench:
    """The processes under test and a store."""

    folder: Path
    server: psutil.Process
    store: ArtifactStore
    started: psutil.Popen | None = None

    @property
    def worker(self) -> psutil.Popen:
        """The worker; started with the first batch that is fed: runs have to wait while their creation is timed."""
        if self.started is None:
            self.started = _worker(self.folder)
        return self.started

    def batch(self, name: str, videos: int, text: str = "") -> BatchManifest:
        """A batch of files, each with content of its own."""
        sources = self.folder / "videos" / name
        sources.mkdir(parents=True)
        entries = []
        for i in range(videos):
            path = sources / f"{i}.mp4"
            path.write_text(f"{text}{name} {i}")
            entries.append(BatchEntry(f"v{i}", str(path), i + 1))
        return submit(self.store, BatchManifest.of(name, entries, {"preset": "draft"}))[0]

    def feed(self, batch: str, **more: Any) -> None:
        """Start a feeder, and the worker if there is none."""
        assert self.worker.is_running()
        request = FeedRequest(store=self.store.url, batch=batch, poll_s=1.0, outstanding=50, **more)
        _with_queue(self.store, batch, lambda queue: start_feeder(queue, request))

    def ended(self, batch: str) -> int:
        """How many videos are done."""
        return batch_status(self.store, Tables(self.store), batch).videos["done"]

    def cpu_s(self) -> float:
        """CPU seconds of the server, its database, and the worker with all its runs so far."""
        total = 0.0
        for root in (self.server, psutil.Process(self.worker.pid)):
            for process in [root, *root.children(recursive=True)]:
                times = process.cpu_times()
                total += times.user + times.system + times.children_user + times.children_system
        return total


def _with_queue(store: ArtifactStore, batch: str, work: Callable[[Queue], Any]) -> Any:
    async def run() -> Any:
        async with get_client() as client:
            return await work(Queue(client, store.url, batch))

    return asyncio.run(run())


def _until(condition: Callable[[], bool], limit_s: float = 7200.0) -> None:
    end = time.monotonic() + limit_s
    while not condition():
        if time.monotonic() > end:
            raise TimeoutError(f"waited for more than {limit_s:.0f} s")
        time.sleep(0.5)


@contextmanager
def running() -> Iterator[Bench]:
    """Start everything in a folder of its own, and stop it."""
    folder = Path(tempfile.mkdtemp(prefix="ahoy-bench-"))
    os.environ["AHOY_SERVER"] = str(folder)
    port = _free_port()
    command = [sys.executable, "-m", "flows", "server", "--no-install", "--data", str(folder), "--port", str(port)]
    server = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE)
    bench = None
    try:
        assert server.stdout is not None and server.stdout.readline().startswith(b"Prefect's pages")
        with connected(Place(folder)):
            entrypoints = {**ENTRYPOINTS, PROCESS_VIDEO: "benchmarks.noop.process_video"}
            asyncio.run(install(Installation(entrypoints=entrypoints)))
            bench = Bench(folder, psutil.Process(_prefect_pid(folder)), ArtifactStore(folder / "store"))
            yield bench
    finally:
        if bench is not None and bench.started is not None:
            bench.started.terminate()
            bench.started.wait()
        server.terminate()
        server.wait()
        shutil.rmtree(folder)


def _worker(folder: Path) -> psutil.Popen:
    command = [sys.executable, "-m", "flows", "worker", "--limit", str(SLOTS), "--data", str(folder)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    log = (folder / "worker.log").open("wb")
    return psutil.Popen(command, env=environment, cwd=ROOT, stdout=log, stderr=log, start_new_session=True)


def _prefect_pid(folder: Path) -> int:
    return int((folder / "prefect.pid").read_text())


def _free_port() -> int:
    import socket

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def submit_rate(bench: Bench, runs: int) -> dict[str, float]:
    """Flow runs created a second, by the code that the feeder uses; deleted afterwards, so that nothing tends them."""
    manifest = bench.batch("submit", runs)
    work = [Work(entry.video_id, 1) for entry in manifest.entries]
    parameters = [video_parameters(manifest, entry, 1, bench.store.url) for entry in manifest.entries]

    async def create(queue: Queue) -> tuple[float, float]:
        started, before = time.perf_counter(), _cpu_s(bench.server)
        await queue.create(work, parameters)
        elapsed, cpu_s = time.perf_counter() - started, _cpu_s(bench.server) - before
        for run in [run async for run in queue.runs(live=True)]:
            await queue.client.delete_flow_run(run.id)
        return elapsed, cpu_s

    elapsed, cpu_s = _with_queue(bench.store, "submit", create)
    return {"submit_per_s": runs / elapsed, "submit_server_cpu_ms_per_run": 1000 * cpu_s / runs}


def overhead(bench: Bench, videos: int) -> dict[str, float]:
    """Seconds of the slot per video, less what its stages took: creating, starting, reporting, ending."""
    bench.batch("warm", SLOTS)
    bench.feed("warm")
    _until(lambda: bench.ended("warm") == SLOTS)
    bench.batch("overhead", videos)
    cpu = bench.cpu_s()
    started = time.perf_counter()
    bench.feed("overhead")
    _until(lambda: bench.ended("overhead") == videos)
    elapsed = time.perf_counter() - started
    stages = batch_status(bench.store, Tables(bench.store), "overhead").cost.wall_s
    return {
        "overhead_s_per_video": (elapsed * SLOTS - stages) / videos,
        "overhead_cpu_s_per_video": (bench.cpu_s() - cpu) / videos,
    }


def skip(bench: Bench) -> dict[str, float]:
    """Milliseconds from the start of a task to its end, for a stage that the store already holds."""
    bench.feed("overhead", videos=("v0", "v1", "v2", "v3", "v4", "v5"))
    ids: list[str] = []

    async def again(queue: Queue) -> list[float]:
        ids[:] = [run.flow_run_id for run in await queue.seen() if run.attempt == 2 and run.state == "done"]
        if len(ids) < 6:
            return []
        tasks = await queue.client.read_task_runs(flow_run_filter=FlowRunFilter(id=FlowRunFilterId(any_=ids)))
        return [1000 * task.total_run_time.total_seconds() for task in tasks if task.name.split()[0] in NAMES]

    times: list[float] = []

    def measured() -> bool:
        times[:] = _with_queue(bench.store, "overhead", again)
        return bool(times)

    _until(measured)
    return {"skip_ms_per_stage": statistics.median(times), "skip_ms_per_stage_worst": max(times)}


def status_10k(bench: Bench, videos: int = 10_000) -> dict[str, float]:
    """Seconds of `batch_status`: nine tenths of the rows compacted, the rest as its workers left them."""
    entries = [BatchEntry(f"v{i}", f"/videos/{i}.mp4", i + 1) for i in range(videos)]
    submit(bench.store, BatchManifest.of("large", entries, {"preset": "draft"}))
    tables = Tables(bench.store)
    old = videos * 9 // 10
    for table, rows in (("attempts", _attempts), ("stages", _stages)):
        tables.append(table, [row for i in range(old) for row in rows(i)], batch="large")
    for i in range(old, videos):
        if i % 10 == 0:
            tables.append("attempts", _attempts(i), batch="large")
            tables.append("stages", _stages(i), batch="large")
    times = []
    for _ in range(3):
        started = time.perf_counter()
        cpu = time.process_time()
        batch_status(bench.store, Tables(bench.store), "large", NAMES)
        times.append((time.perf_counter() - started, time.process_time() - cpu))
    wall, used = sorted(times)[1]
    return {"status_10k_s": wall, "status_10k_cpu_s": used}


def _attempts(i: int) -> list[dict[str, Any]]:
    return [{**attempt_row(f"v{i}", 1, n, state), "run_id": f"r{i}"} for n, state in enumerate(("running", "done"))]


def _stages(i: int) -> list[dict[str, Any]]:
    same = {"video_id": f"v{i}", "run_id": f"r{i}", "key": "0" * 64, "stage_version": 1, "state": "done"}
    more = {"started_at": datetime.now(UTC), "wall_s": 1.0, "cpu_s": 1.0, "attempt_number": 1}
    return [{**same, **more, "stage": name, "seq": n} for n, name in enumerate(NAMES)]


def dead_run(bench: Bench) -> dict[str, float]:
    """Seconds until a run is marked Crashed after it, its worker and everything between were killed at once."""
    bench.batch("dead", 1, HOLD.decode())
    bench.feed("dead", tries=1)
    _until(lambda: batch_status(bench.store, Tables(bench.store), "dead").videos["running"] == 1)
    time.sleep(5.0)
    killed = time.perf_counter()
    victims = [psutil.Process(bench.worker.pid), *psutil.Process(bench.worker.pid).children(recursive=True)]
    for process in victims:
        process.send_signal(signal.SIGKILL)

    async def crashed(queue: Queue) -> bool:
        return any(run.state == "crashed" for run in await queue.seen())

    _until(lambda: bool(_with_queue(bench.store, "dead", crashed)), 600.0)
    return {"dead_run_s": time.perf_counter() - killed}


def memory(bench: Bench, videos: int) -> dict[str, Any]:
    """Growth of server and worker between the first tenth of the videos and the last."""
    bench.batch("memory", videos)
    bench.feed("memory")
    readings: list[tuple[int, float, float]] = []

    def look() -> bool:
        done = bench.ended("memory")
        readings.append((done, _rss(bench.server), _rss(psutil.Process(bench.worker.pid))))
        time.sleep(10.0)
        return done == videos

    _until(look, 4 * 3600.0)
    first = next(reading for reading in readings if reading[0] >= videos // 10)
    last = readings[-1]
    return {
        "memory_videos": videos,
        "server_mb_growth": last[1] - first[1],
        "worker_mb_growth": last[2] - first[2],
        "server_mb": last[1],
        "worker_mb": last[2],
        # A leak grows to the end, a cache does not: about twenty readings tell which.
        "memory_readings": [[n, round(a, 1), round(b, 1)] for n, a, b in readings[:: max(1, len(readings) // 20)]],
    }


def _cpu_s(process: psutil.Process) -> float:
    times = process.cpu_times()
    return float(times.user + times.system)


def _rss(process: psutil.Process) -> float:
    return float(process.memory_info().rss / 2**20)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--only", choices=PARTS, nargs="*", default=PARTS, help="parts to measure")
    parser.add_argument("--videos", type=int, default=1000, help="of the part `memory`")
    arguments = parser.parse_args()
    result: dict[str, Any] = {"machine": machine(), "load_before": os.getloadavg()[0]}
    with running() as bench:
        measures: dict[str, Callable[[], dict[str, float]]] = {
            "submit": lambda: submit_rate(bench, 200),
            "overhead": lambda: overhead(bench, 20),
            "skip": lambda: skip(bench),
            "status": lambda: status_10k(bench),
            "memory": lambda: memory(bench, arguments.videos),
            "dead": lambda: dead_run(bench),  # last: it kills the worker
        }
        for name, measure in measures.items():
            if name in arguments.only:
                result |= measure()
                print(name, json.dumps(result), flush=True)
                arguments.json.write_text(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
