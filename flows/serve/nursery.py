"""Starts flow runs by forking a process that has imported everything already: 0.1 s instead of ten.

Each run is a process of its own, so one that crashes the interpreter takes nobody with it. Run as
`python -m flows.serve.nursery SOCKET`, with a pipe to the worker on stdin: when it closes, no new runs are taken, those
at work are finished, and the nursery ends. The nursery has one thread, as forking asks for.
"""

from __future__ import annotations

import faulthandler
import json
import logging
import os
import runpy
import selectors
import signal
import socket
import struct
import sys
import traceback
import warnings
from collections.abc import Callable
from contextlib import suppress
from typing import Any

# The flows, and what Prefect and they import only once they run.
PRELOADED = (
    "prefect.flow_engine",
    "prefect.task_engine",
    "prefect.deployments",
    "prefect.concurrency.sync",
    "prefect.utilities.visualization",
    "anyio._backends._asyncio",
    "pyarrow.compute",
    "storage_schema.remote",
    "flows.process_video",
    "flows.feed_batch",
)
READY = b"ready\n"
SEND_S = 5.0  # for what a run said last to reach the server; as long as Prefect gives its logs


def _send_what_waits() -> None:
    """Log lines and events of the last seconds: Prefect sends batches, and `os._exit` runs no exit functions."""
    from prefect.events.worker import EventsWorker

    with suppress(Exception):  # a server that is gone must not keep a run from ending
        logging.shutdown()
        EventsWorker.drain_all(timeout=SEND_S)


class Nursery:
    """Accepts orders on a Unix socket and forks one process for each.

    Args:
        path: of the socket.
        body: what a new process does; it gets no arguments and is never returned from.
    """

    def __init__(self, path: str, body: Callable[[], None]) -> None:
        self._body = body
        self._selector = selectors.DefaultSelector()
        self._runs: dict[int, socket.socket] = {}
        self._listener = socket.socket(socket.AF_UNIX)
        self._listener.bind(path)
        self._listener.listen(64)
        self._selector.register(self._listener, selectors.EVENT_READ, self._accept)
        self._selector.register(sys.stdin.fileno(), selectors.EVENT_READ, self._worker_gone)
        self._wakeup, writer = os.pipe()
        for descriptor in (self._wakeup, writer):
            os.set_blocking(descriptor, False)
        signal.signal(signal.SIGCHLD, lambda number, frame: None)
        signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
        self._selector.register(self._wakeup, selectors.EVENT_READ, self._reap)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, signal.SIG_IGN)  # for the terminal's whole group; the worker says when to end
        self._open = True

    def serve(self) -> None:
        """Work until the worker is gone and no run is left."""
        while self._open or self._runs:
            for key, _ in self._selector.select():
                key.data(key.fileobj)

    def _accept(self, listener: Any) -> None:
        connection, _ = listener.accept()
        connection.settimeout(10.0)
        try:
            size = struct.unpack("!I", _exactly(connection, 4))[0]
            order = json.loads(_exactly(connection, size))
        except (OSError, ValueError, struct.error):
            connection.close()
            return
        pid = os.fork()
        if pid == 0:
            self._become(order, connection)
        connection.setblocking(False)
        self._runs[pid] = connection
        self._selector.register(connection, selectors.EVENT_READ, lambda fd: self._heard(pid, connection))

    def _become(self, order: dict[str, Any], connection: socket.socket) -> None:
        """Turn this fork into the run; never returns."""
        status = 1
        try:
            signal.set_wakeup_fd(-1)
            for number in (signal.SIGCHLD, signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
                signal.signal(number, signal.SIG_DFL if number != signal.SIGINT else signal.default_int_handler)
            # A copy of another run's connection held here would keep the nursery from noticing that it broke.
            for key in list(self._selector.get_map().values()):
                if key.fileobj not in (sys.stdin.fileno(),):
                    os.close(key.fd)
            connection.close()
            os.setsid()
            os.environ.clear()
            os.environ.update(order["environment"])
            os.chdir(order["folder"])
            self._body()
            status = 0
        except SystemExit as end:
            status = end.code if isinstance(end.code, int) else int(end.code is not None)
        except BaseException:
            traceback.print_exc()
        finally:
            _send_what_waits()
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(status)

    def _heard(self, pid: int, connection: socket.socket) -> None:
        try:
            numbers = connection.recv(64)
        except OSError:
            numbers = b""
        if numbers:
            for number in numbers:
                os.kill(pid, number)
            return
        self._selector.unregister(connection)
        if pid in self._runs:
            os.kill(pid, signal.SIGKILL)

    def _reap(self, wakeup: Any) -> None:
        os.read(wakeup, 4096)
        while self._runs:
            pid, status = os.waitpid(-1, os.WNOHANG)
            if pid == 0:
                return
            connection = self._runs.pop(pid)
            code = os.waitstatus_to_exitcode(status)
            with suppress(OSError):
                connection.send(struct.pack("!i", code))
            if connection in [key.fileobj for key in self._selector.get_map().values()]:
                self._selector.unregister(connection)
            connection.close()

    def _worker_gone(self, stdin: Any) -> None:
        if os.read(stdin, 4096):
            return
        self._selector.unregister(stdin)
        self._selector.unregister(self._listener)
        self._listener.close()
        self._open = False


def run_engine() -> None:
    """What a fork does: Prefect's own entry point for the flow run that the environment names."""
    import prefect.context

    faulthandler.enable()
    prefect.context.refresh_global_settings_context()
    sys.argv = ["prefect.engine"]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        runpy.run_module("prefect.engine", run_name="__main__")


def _exactly(connection: socket.socket, size: int) -> bytes:
    data = b""
    while len(data) < size:
        piece = connection.recv(size - len(data))
        if not piece:
            raise OSError("the relay went away")
        data += piece
    return data


def load_models() -> None:
    """Read once, for all runs to come, the models of `roles.yaml`; forks share their memory.

    Nothing may open a GPU here: whether there is one is asked of NVML, which forks survive. One thread reads: OpenMP's
    threads do not survive a fork. What cannot be read is the run's to complain of, whose stage then says why.
    """
    import torch

    from ahoy_core.models.errors import ModelError
    from tasks.fills import fills_from_environment
    from tasks.prior_folder import preload_prior

    os.environ["PYTORCH_NVML_BASED_CUDA_CHECK"] = "1"
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        fills = fills_from_environment()
        fills.preload()
        preload_prior(fills)
    except (ModelError, ValueError, OSError, ImportError) as error:  # of a model, of the prior's files or libraries
        print(f"not loaded beforehand: {error}", file=sys.stderr)
    finally:
        torch.set_num_threads(threads)


def main() -> None:
    """Import, load models, say that it is ready, serve."""
    for name in PRELOADED:
        __import__(name)
    load_models()
    nursery = Nursery(sys.argv[1], run_engine)
    os.write(sys.stdout.fileno(), READY)
    nursery.serve()


if __name__ == "__main__":
    main()
