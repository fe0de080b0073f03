"""A real HTTP server on the loopback interface that counts who asks for what, and misbehaves on request."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer


@dataclass(frozen=True)
class Request:
    method: str
    path: str
    headers: dict[str, str]


Answer = Callable[["Handler"], None]


class Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def _serve(self) -> None:
        served: Served = self.server.served  # type: ignore[attr-defined]
        path = self.path.partition("?")[0]
        served.requests.append(Request(self.command, self.path, {k.lower(): v for k, v in self.headers.items()}))
        answer = served.answers.get(path)
        if answer is None:
            self.reply(404, b"nothing here")
        else:
            answer(self)

    do_GET = do_HEAD = do_POST = _serve  # noqa: N815 - the names that http.server calls

    def reply(self, status: int, body: bytes = b"", **headers: str) -> None:
        self.send_response(status)
        named = {name.replace("_", "-"): value for name, value in headers.items()}
        for name, value in {"Content-Length": str(len(body)), **named}.items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def log_message(self, format: str, *args: object) -> None:
        return


@dataclass
class Served:
    """What the server answers, and what it was asked."""

    port: int = 0
    answers: dict[str, Answer] = field(default_factory=dict)
    requests: list[Request] = field(default_factory=list)

    def url(self, path: str = "", host: str = "127.0.0.1") -> str:
        return f"http://{host}:{self.port}{path}"

    def file(self, path: str, body: bytes, **headers: str) -> str:
        """Serve bytes, with ranges where an ETag is given (RFC 9110, 13.1.5 and 14.2)."""

        def answer(handler: Handler) -> None:
            etag, asked = headers.get("ETag"), handler.headers.get("Range")
            if etag and handler.headers.get("If-None-Match") == etag:
                handler.reply(304, **headers)
            elif etag and asked and handler.headers.get("If-Range") == etag:
                start = int(asked.removeprefix("bytes=").rstrip("-"))
                place = f"bytes {start}-{len(body) - 1}/{len(body)}"
                handler.reply(206, body[start:], Content_Range=place, **headers)
            else:
                handler.reply(200, body, **headers)

        self.answers[path] = answer
        return self.url(path)

    def redirect(self, path: str, location: str, status: int = 302) -> str:
        self.answers[path] = lambda handler: handler.reply(status, Location=location)
        return self.url(path)

    def asked(self, path: str) -> int:
        return sum(request.path.partition("?")[0] == path for request in self.requests)


@contextmanager
def serving(host: str = "127.0.0.1") -> Iterator[Served]:
    server = ThreadingHTTPServer((host, 0), Handler)
    server.daemon_threads = True
    served = Served(server.server_port)
    server.served = served  # type: ignore[attr-defined]
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
    thread.start()
    try:
        yield served
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
