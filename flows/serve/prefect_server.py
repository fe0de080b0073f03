"""Prefect's own server as a child process: started on a free port, watched, stopped."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from flows.serve.errors import NoServerError, ServerError
from flows.serve.place import AUTH, QUIET, URL, check_answers

READY_S = 600.0  # it is at work as long as it lives; a busy machine is no error
STOP_S = 20.0


@dataclass(frozen=True)
class PrefectServer:
    """How to start it.

    Attributes:
        host: address to listen on.
        port: likewise.
        database_url: `postgresql+asyncpg://...`.
        auth: `user:password` that every request has to carry, None to let anyone in.
        home: folder for what Prefect keeps beside the database.
        log: file for its output.
    """

    host: str
    port: int
    database_url: str
    auth: str | None
    home: Path
    log: Path

    @property
    def url(self) -> str:
        """Of the API, as clients on this machine reach it."""
        host = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}.get(self.host, self.host)
        return f"http://{host}:{self.port}/api"

    def client(self) -> dict[str, str]:
        """Return the settings that a client needs."""
        return {URL: self.url} | ({AUTH: self.auth} if self.auth else {})

    def start(self) -> subprocess.Popen[bytes]:
        """Start the process; it is not ready yet."""
        environment = {
            **{name: value for name, value in os.environ.items() if name not in (URL, AUTH)},
            **QUIET,
            "PREFECT_HOME": str(self.home),
            "PREFECT_SERVER_DATABASE_CONNECTION_URL": self.database_url,
            "PREFECT_SERVER_LOGGING_LEVEL": os.environ.get("PREFECT_SERVER_LOGGING_LEVEL", "WARNING"),
            "PREFECT_UI_API_URL": "/api",
            "PREFECT__SERVER_FINAL": "1",
            # It looks at every run that was cancelled lately, one by one: every 20 s that is a third of a core for 200.
            "PREFECT_SERVER_SERVICES_CANCELLATION_CLEANUP_LOOP_SECONDS": "300",
            **({"PREFECT_SERVER_API_AUTH_STRING": self.auth} if self.auth else {}),
        }
        command = [sys.executable, "-m", "uvicorn", "--factory", "prefect.server.api.server:create_app"]
        command += ["--host", self.host, "--port", str(self.port), "--log-level", "warning"]
        with self.log.open("ab") as log:
            # A session of its own: Ctrl-C in the terminal reaches `ahoy server`, which stops things in order.
            return subprocess.Popen(
                command, env=environment, stdout=log, stderr=log, stdin=subprocess.DEVNULL, start_new_session=True
            )

    def wait_ready(self, process: subprocess.Popen[bytes]) -> None:
        """Wait until it answers.

        Raises:
            ServerError: it ended, or took longer than `READY_S`; the message holds the end of its log.
        """
        deadline = time.monotonic() + READY_S
        while time.monotonic() < deadline and process.poll() is None:
            try:
                check_answers(self.client(), timeout_s=2.0)
            except NoServerError:
                time.sleep(0.2)
            else:
                return
        tail = "\n".join(self.log.read_text(errors="replace").splitlines()[-15:])
        how = "did not answer" if process.poll() is None else f"ended with status {process.returncode}"
        stop(process)
        raise ServerError(f"Prefect's server {how}; the end of {self.log}:\n{tail}")


def stop(process: subprocess.Popen[bytes]) -> None:
    """Ask the server to end, and insist."""
    process.terminate()
    try:
        process.wait(STOP_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def check_port(host: str, port: int) -> None:
    """Refuse a port on which something listens already.

    Raises:
        ServerError: with what to do.
    """
    with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            raise ServerError(
                f"cannot listen on {host}:{port} ({error.strerror}); give another with --port (or --host)"
            ) from None
