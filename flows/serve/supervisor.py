"""`ahoy server`: Postgres and Prefect's server, started in order, kept alive, stopped in order."""

from __future__ import annotations

import fcntl
import os
import signal
import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import psutil

from flows.serve.errors import ServerError
from flows.serve.place import Address, Place
from flows.serve.postgres import Postgres
from flows.serve.prefect_server import PrefectServer, check_port, stop

CHECK_S = 1.0
RESTART_S = 5.0  # a server that dies at once is not started again more often than this


@dataclass
class Supervisor:
    """Looks after one server.

    Attributes:
        place: its folder.
        host: address to listen on.
        port: likewise.
        database_url: a database of the user's own; None for embedded Postgres.
        auth: whether requests have to carry the password.
    """

    place: Place
    host: str = "127.0.0.1"
    port: int = 4200
    database_url: str | None = None
    auth: bool = True
    _stop: threading.Event = field(default_factory=threading.Event)

    def run(self, ready: Callable[[PrefectServer], None]) -> None:
        """Start everything, call `ready`, and watch until SIGINT or SIGTERM.

        Raises:
            ServerError: another server runs from this folder, the port is taken, or something does not start.
        """
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda got, frame: self._stop.set())
        self.place.make()
        with self._only_one():
            _end_orphan(self.place)
            check_port(self.host, self.port)
            postgres = None if self.database_url else Postgres(self.place.database)
            if postgres:
                postgres.start()
            try:
                self._run_prefect(postgres, ready)
            finally:
                if postgres:
                    postgres.stop()

    def _run_prefect(self, postgres: Postgres | None, ready: Callable[[PrefectServer], None]) -> None:
        server = PrefectServer(
            self.host,
            self.port,
            self.database_url or (postgres.url if postgres else ""),
            self.place.secret() if self.auth else None,
            self.place.folder / "prefect",
            self.place.logs / "server.log",
        )
        process = self._start(server)
        try:
            server.wait_ready(process)
            self.place.write_address(Address(server.url, os.getpid(), self.auth))
            ready(server)
            pause = CHECK_S
            while not self._stop.wait(pause):
                pause = CHECK_S
                if postgres and not _alive(postgres.pid()):
                    postgres.start()
                if process.poll() is not None:
                    process, pause = self._start(server), RESTART_S
        finally:
            stop(process)
            (self.place.folder / "prefect.pid").unlink(missing_ok=True)

    def _start(self, server: PrefectServer) -> subprocess.Popen[bytes]:
        process = server.start()
        (self.place.folder / "prefect.pid").write_text(str(process.pid))
        return process

    @contextmanager
    def _only_one(self) -> Iterator[None]:
        with (self.place.folder / "lock").open("w") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                address = self.place.read_address()
                where = f" at {address.url}" if address else ""
                raise ServerError(
                    f"a server runs from {self.place.folder} already{where}; stop it first, or give another --data"
                ) from None
            yield


def _end_orphan(place: Place) -> None:
    """End the Prefect server that a killed `ahoy server` left behind."""
    try:
        orphan = psutil.Process(int((place.folder / "prefect.pid").read_text()))
        if "prefect.server.api.server:create_app" in orphan.cmdline():
            orphan.terminate()
            orphan.wait(20)
    except (FileNotFoundError, ValueError, psutil.NoSuchProcess):
        return


def _alive(pid: int | None) -> bool:
    return pid is not None and psutil.pid_exists(pid)
