"""A real S3 server in a process of its own, and a proxy before it that cuts, delays and spoils."""

from __future__ import annotations

import http.client
import socket
import subprocess
import sys
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import fsspec

# One request at a time: moto tests for an object and then writes it, which a real S3 does in one step.
SERVER = """
import sys
from moto.server import DomainDispatcherApplication, create_backend_app
from werkzeug.serving import run_simple
run_simple("127.0.0.1", int(sys.argv[1]), DomainDispatcherApplication(create_backend_app), threaded=False)
"""
CREDENTIALS = {"AWS_ACCESS_KEY_ID": "test", "AWS_SECRET_ACCESS_KEY": "test", "AWS_DEFAULT_REGION": "us-east-1"}
CHANGES = ("PUT", "POST", "DELETE")
FULL = (
    b"<Error><Code>XMinioStorageFull</Code>"
    b"<Message>Storage backend has reached its minimum free drive threshold.</Message></Error>"
)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def s3_server() -> Iterator[int]:
    """Port of a running server."""
    port = free_port()
    server = subprocess.Popen(
        [sys.executable, "-c", SERVER, str(port)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        while server.poll() is None:
            try:
                socket.create_connection(("127.0.0.1", port), timeout=1).close()
                break
            except OSError:
                time.sleep(0.1)
        else:
            raise RuntimeError("the S3 server did not start")
        yield port
    finally:
        server.kill()
        server.wait()


@contextmanager
def s3_bucket(port: int) -> Iterator[str]:
    """Name of an empty bucket; until the end `s3://` leads to the server, its own tries cut short."""
    import s3fs

    before, tries = dict(fsspec.config.conf), s3fs.S3FileSystem.retries
    s3fs.S3FileSystem.retries = 2
    use(f"http://127.0.0.1:{port}")
    name = f"b-{uuid.uuid4().hex[:12]}"
    make_bucket(port, name)
    try:
        yield name
    finally:
        fsspec.config.conf.clear()
        fsspec.config.conf.update(before)
        s3fs.S3FileSystem.retries = tries
        s3fs.S3FileSystem.clear_instance_cache()


def make_bucket(port: int, name: str) -> None:
    connection = http.client.HTTPConnection("127.0.0.1", port)
    connection.request(
        "PUT", f"/{name}", headers={"Authorization": "AWS4-HMAC-SHA256 Credential=test/x/us-east-1/s3/x"}
    )
    assert connection.getresponse().status == 200
    connection.close()


Plan = Callable[[str, str], str]
"""What to do with a request, by method and path: pass, cut (never arrives), lose (arrives, its answer does not),
error (500), full (507), hang (no answer until the client gives up), slow (the answer in small pieces), short (the
answer ends half-way)."""


class Proxy(ThreadingHTTPServer):
    """Hands requests on to the S3 server at `port` as `plan` says; keeps what it saw in `seen`."""

    daemon_threads = True

    def __init__(self, port: int) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.target = port
        self.plan: Plan = lambda method, path: "pass"
        self.seen: list[tuple[str, str]] = []
        self.closing = threading.Event()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}"


@contextmanager
def proxy_before(port: int) -> Iterator[Proxy]:
    proxy = Proxy(port)
    thread = threading.Thread(target=proxy.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
    thread.start()
    try:
        yield proxy
    finally:
        proxy.closing.set()
        proxy.shutdown()
        proxy.server_close()
        thread.join()


class _Handler(BaseHTTPRequestHandler):
    server: Proxy
    protocol_version = "HTTP/1.1"

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing."""

    def handle_any(self) -> None:
        body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        action = self.server.plan(self.command, self.path)
        self.server.seen.append((self.command, self.path))
        self.close_connection = True
        if action == "cut":
            self.connection.close()
        elif action == "hang":
            self.server.closing.wait(10)
        elif action in ("error", "full"):
            self._answer(500 if action == "error" else 507, b"" if action == "error" else FULL)
        else:
            self._forward(body, action)

    do_GET = do_PUT = do_POST = do_DELETE = do_HEAD = handle_any  # noqa: N815

    def _forward(self, body: bytes, action: str) -> None:
        upstream = http.client.HTTPConnection("127.0.0.1", self.server.target)
        headers = {k: v for k, v in self.headers.items() if k.lower() not in ("connection", "expect")}
        upstream.request(self.command, self.path, body, headers)
        answer = upstream.getresponse()
        data = answer.read()
        upstream.close()
        if action == "lose":
            self.connection.close()
            return
        hop = ("connection", "content-length", "transfer-encoding", "date", "server")
        length = answer.headers.get("Content-Length", "0") if self.command == "HEAD" else str(len(data))
        self.send_response_only(answer.status)
        for name, value in answer.getheaders():
            if name.lower() not in hop:
                self.send_header(name, value)
        self.send_header("Content-Length", length)
        self.send_header("Connection", "close")
        self.end_headers()
        if self.command != "HEAD":
            self._send(data, action)

    def _send(self, data: bytes, action: str) -> None:
        if action == "short":
            data = data[: len(data) // 2]
        step = max(1, len(data) // 5) if action == "slow" else max(1, len(data))
        for start in range(0, len(data), step):
            self.wfile.write(data[start : start + step])
            self.wfile.flush()
            if action == "slow":
                time.sleep(0.02)

    def _answer(self, status: int, body: bytes) -> None:
        self.send_response_only(status)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Connection", "close")
        self.send_header("Content-Type", "application/xml")
        self.end_headers()
        self.wfile.write(body)


def use(endpoint: str, **config: Any) -> None:
    """Send every `s3://` of this process to `endpoint`; few tries, so that what fails fails soon."""
    quick = {"connect_timeout": 30, "read_timeout": 30, "retries": {"max_attempts": 1, "mode": "standard"}, **config}
    options = {"key": "test", "secret": "test", "client_kwargs": {"region_name": "us-east-1"}}
    fsspec.config.conf["s3"] = {**options, "endpoint_url": endpoint, "config_kwargs": quick}
