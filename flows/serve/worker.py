"""`ahoy worker`: Prefect's process worker, whose runs start from a nursery instead of from nothing."""

from __future__ import annotations

import asyncio
import ctypes
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any
from uuid import UUID

import httpx
import psutil
from prefect.client.schemas.objects import FlowRun
from prefect.exceptions import PrefectHTTPStatusError
from prefect.utilities.processutils import command_to_string
from prefect.workers.process import ProcessJobConfiguration, ProcessWorker

from flows.serve import nursery, relay
from flows.serve.errors import ServerError

FEEDERS = 4  # batches that one worker feeds at a time, beside its videos: feeding is light
HAND_OVER_S = 20.0  # for runs to end by themselves; one that does not is found by its silence
_SOCKET = "AHOY_NURSERY"
_M_ARENA_MAX = -8  # of glibc's malloc.h


class WarmJobConfiguration(ProcessJobConfiguration):
    """A process job whose command is the relay, unless the pool names a command of its own."""

    def prepare_for_flow_run(self, *arguments: Any, **named: Any) -> None:
        """Fill in what depends on the run."""
        if self.command is None and _SOCKET in os.environ:
            self.command = command_to_string([sys.executable, "-I", "-S", relay.__file__, os.environ[_SOCKET]])
            self.stream_output = False  # runs write to the worker's own output; a pipe would break when it dies
        super().prepare_for_flow_run(*arguments, **named)


with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # Prefect remarks that this replaces its own process worker, which is meant

    class WarmWorker(ProcessWorker):
        """A process worker with warm starts."""

        type = "process"
        job_configuration = WarmJobConfiguration
        leaving = False

        async def get_and_submit_flow_runs(self) -> list[FlowRun]:
            """Take what is scheduled; nothing any more once the worker is leaving."""
            return [] if self.leaving else await super().get_and_submit_flow_runs()

        def _release_limit_slot(self, flow_run_id: UUID) -> None:
            """Ask for work as soon as there is room for it, not only every few seconds."""
            super()._release_limit_slot(flow_run_id)
            if self._runs_task_group is not None and not self.leaving:
                self._runs_task_group.start_soon(self._fill_slot)

        async def _fill_slot(self) -> None:
            with suppress(httpx.HTTPError, PrefectHTTPStatusError):  # the regular round will ask again
                await self.get_and_submit_flow_runs()


@contextmanager
def running_nursery() -> Iterator[None]:
    """Start the nursery and name its socket in the environment; one that is named there already is shared.

    Raises:
        ServerError: it did not come up.
    """
    if _SOCKET in os.environ:
        yield
        return
    folder = Path(tempfile.mkdtemp(prefix="ahoy-worker-"))
    path = folder / "socket"
    command = [sys.executable, "-m", nursery.__name__, str(path)]
    # A session of its own: what is meant for the worker (Ctrl-C, a group's SIGTERM) must not reach runs by the side.
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True)
    assert process.stdin is not None and process.stdout is not None
    try:
        if process.stdout.readline() != nursery.READY:
            raise ServerError(f"the nursery of this worker did not start (exit status {process.wait()}); see above")
        os.environ[_SOCKET] = str(path)
        yield
    finally:
        os.environ.pop(_SOCKET, None)
        process.stdin.close()
        process.wait()
        shutil.rmtree(folder, ignore_errors=True)


def work(pools: Mapping[str, int], name: str | None) -> None:
    """Take runs until interrupted (SIGINT or SIGTERM); runs at work are then told to stop, and others take them up.

    Args:
        pools: name of a work pool -> how many of its runs at a time.
        name: of the worker in Prefect's pages; by default the machine's and the process's.
    """
    _one_arena()
    warm = hasattr(os, "fork") and sys.platform != "darwin"  # macOS's own libraries do not survive a fork
    with running_nursery() if warm else nullcontext():
        asyncio.run(_work(pools, name or f"{socket.gethostname()}-{os.getpid()}"))


def _one_arena() -> None:
    """Keep the memory of a worker that lives for months flat.

    asyncio starts a thread for each run, to wait for its process; glibc gives threads arenas of their own, which grow
    for as long as new threads come by and are never given back.
    """
    with suppress(OSError, AttributeError):  # another C library than glibc
        ctypes.CDLL(None).mallopt(_M_ARENA_MAX, 1)


async def _work(pools: Mapping[str, int], name: str) -> None:
    workers = [WarmWorker(work_pool_name=pool, limit=limit, name=name) for pool, limit in pools.items()]
    told = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, told.set)
    working = asyncio.gather(*(worker.start() for worker in workers))
    stop = asyncio.create_task(told.wait())
    either: set[asyncio.Future[Any]] = {working, stop}
    await asyncio.wait(either, return_when=asyncio.FIRST_COMPLETED)
    if told.is_set():
        for worker in workers:
            worker.leaving = True
        await _end_runs()
        working.cancel()
    stop.cancel()
    with suppress(asyncio.CancelledError):
        await working


async def _end_runs() -> None:
    """Let the runs say that they end, in the ledger and to Prefect; cancelled, the worker would kill them at once."""
    runs = [child for child in psutil.Process().children() if relay.__file__ in child.cmdline()]
    for run in runs:
        with suppress(psutil.NoSuchProcess):
            run.terminate()
    deadline = asyncio.get_running_loop().time() + HAND_OVER_S
    while any(run.is_running() for run in runs) and asyncio.get_running_loop().time() < deadline:
        await asyncio.sleep(0.1)
