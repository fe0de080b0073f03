"""`ahoy worker`: Prefect's process worker, whose runs start from a nursery instead of from nothing."""

from __future__ import annotations

import asyncio
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar

from prefect.utilities.processutils import command_to_string
from prefect.workers.process import ProcessJobConfiguration, ProcessWorker

from flows.serve import nursery, relay
from flows.serve.errors import ServerError

HEARTBEAT_S = 30  # the shortest that Prefect allows
QUERY_S = 2.0  # how often an idle worker asks for work
_SOCKET = "AHOY_NURSERY"


class WarmJobConfiguration(ProcessJobConfiguration):
    """A process job whose command is the relay, unless the pool names a command of its own."""

    def prepare_for_flow_run(self, *arguments: Any, **named: Any) -> None:
        """Fill in what depends on the run."""
        if self.command is None and _SOCKET in os.environ:
            self.command = command_to_string([sys.executable, "-I", "-S", relay.__file__, os.environ[_SOCKET]])
            self.stream_output = False  # runs write to the worker's own output; a pipe would break when it dies
        super().prepare_for_flow_run(*arguments, **named)


class WarmWorker(ProcessWorker):
    """A process worker with warm starts."""

    type = "process"
    job_configuration: ClassVar[type[ProcessJobConfiguration]] = WarmJobConfiguration  # type: ignore[misc]


@contextmanager
def running_nursery() -> Iterator[None]:
    """Start the nursery and name its socket in the environment.

    Raises:
        ServerError: it did not come up.
    """
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


def work(pool: str, limit: int, name: str | None) -> None:
    """Take runs from a pool until interrupted (SIGINT or SIGTERM); runs at work are then told to stop.

    Args:
        pool: name of the work pool.
        limit: how many runs at a time.
        name: of the worker in Prefect's pages; by default Prefect makes one up.
    """
    os.environ.setdefault("PREFECT_FLOWS_HEARTBEAT_FREQUENCY", str(HEARTBEAT_S))
    with running_nursery() if hasattr(os, "fork") and sys.platform != "darwin" else _nothing():
        asyncio.run(_work(pool, limit, name))


async def _work(pool: str, limit: int, name: str | None) -> None:
    worker = WarmWorker(work_pool_name=pool, limit=limit, name=name, create_pool_if_not_found=False)
    task = asyncio.ensure_future(worker.start())
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, task.cancel)
    try:
        await task
    except asyncio.CancelledError:
        pass


@contextmanager
def _nothing() -> Iterator[None]:
    yield
