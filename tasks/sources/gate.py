"""A forward proxy on this machine that connects to checked addresses only.

yt-dlp makes its own connections, several kinds of them, and follows redirects by itself. With this as its proxy every
one of them passes `connect`, whatever part of yt-dlp makes it: names are looked up and checked here, once.
"""

from __future__ import annotations

import selectors
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import cast

import httpx

from tasks.errors import BadInputError, RefusedSourceError, TransientError
from tasks.sources.address import connect
from tasks.sources.policy import SourcePolicy
from tasks.sources.uri import check_web

_BLOCK = 65536
_DROPPED = frozenset({"proxy-connection", "proxy-authorization", "connection", "keep-alive"})


class Gate(ThreadingHTTPServer):
    """The proxy, listening on a free port of the loopback interface."""

    daemon_threads = True

    def __init__(self, policy: SourcePolicy) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.policy = policy
        self.refusals: list[BadInputError] = []

    @property
    def url(self) -> str:
        """What a client is told to use."""
        return f"http://127.0.0.1:{self.server_port}"


@contextmanager
def open_gate(policy: SourcePolicy) -> Iterator[Gate]:
    """Run the proxy while the block runs."""
    with Gate(policy) as gate:
        thread = threading.Thread(target=gate.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True)
        thread.start()
        try:
            yield gate
        finally:
            gate.shutdown()
            thread.join()


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    @property
    def _gate(self) -> Gate:
        return cast(Gate, self.server)

    def do_CONNECT(self) -> None:
        upstream = self._open(f"https://{self.path}")
        if upstream is None:
            return
        with upstream:
            self.send_response(200, "Connection established")
            self.end_headers()
            self._relay(upstream)

    def _forward(self) -> None:
        upstream = self._open(self.path)
        if upstream is None:
            return
        url = httpx.URL(self.path)
        lines = [f"{self.command} {url.raw_path.decode('ascii')} HTTP/1.1"]
        lines += [f"{name}: {value}" for name, value in self.headers.items() if name.lower() not in _DROPPED]
        lines += ["Connection: close", "", ""]
        with upstream:
            upstream.sendall("\r\n".join(lines).encode("latin-1"))
            status, end, rest = _first_line(upstream)
            if not end:
                self.send_error(502)
                return
            # The client must hear that this connection ends here: its next request on it would meet the end.
            self.connection.sendall(status + b"\r\nConnection: close\r\n" + rest)
            self._relay(upstream)

    do_GET = do_HEAD = do_POST = _forward  # noqa: N815 - the names that http.server calls

    def _open(self, address: str) -> socket.socket | None:
        """A connection to where the client wants to go, or an answer that says why not."""
        self.close_connection = True
        try:
            url = check_web(address, self._gate.policy)
            port = url.port or (443 if url.scheme == "https" else 80)
            return connect(url.raw_host.decode("ascii").strip("[]"), port, self._gate.policy)
        except (BadInputError, TransientError) as error:
            if isinstance(error, RefusedSourceError):
                self._gate.refusals.append(error)
            self.send_error(403 if isinstance(error, BadInputError) else 504)
            return None

    def _relay(self, upstream: socket.socket) -> None:
        """Carry bytes both ways until either side closes or nothing moves for a while."""
        self.wfile.flush()
        ends = {self.connection: upstream, upstream: self.connection}
        with selectors.DefaultSelector() as ready:
            for end in ends:
                end.settimeout(self._gate.policy.read_timeout_s)
                ready.register(end, selectors.EVENT_READ)
            while events := ready.select(self._gate.policy.read_timeout_s):
                for key, _ in events:
                    end = cast(socket.socket, key.fileobj)
                    try:
                        data = end.recv(_BLOCK)
                        if not data:
                            return
                        ends[end].sendall(data)
                    except OSError:
                        return

    def log_message(self, format: str, *args: object) -> None:
        """Nothing: addresses may hold secrets."""


def _first_line(upstream: socket.socket) -> tuple[bytes, bytes, bytes]:
    """The line, its end (nothing if it never came) and what came with it."""
    head = b""
    while b"\r\n" not in head and len(head) < _BLOCK:
        try:
            data = upstream.recv(_BLOCK)
        except OSError:
            data = b""
        if not data:
            break
        head += data
    return head.partition(b"\r\n")
