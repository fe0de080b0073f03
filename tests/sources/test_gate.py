"""The gate's answers as a client sees them, byte by byte."""

from __future__ import annotations

import socket

import httpx
import pytest

from tasks.sources import SourcePolicy
from tasks.sources.gate import Gate, open_gate

from .server import Handler, Served


def ask(gate: Gate, url: str) -> bytes:
    """Everything that comes back for a GET through the gate."""
    with socket.create_connection(("127.0.0.1", gate.server_port), timeout=30) as client:
        client.sendall(f"GET {url} HTTP/1.1\r\nHost: x\r\nConnection: keep-alive\r\n\r\n".encode())
        return b"".join(iter(lambda: client.recv(65536), b""))


def test_an_answer_says_that_its_connection_ends(server: Served, policy: SourcePolicy) -> None:
    """Otherwise a client keeps the connection, and its next request may be sent into the end of it."""
    soon = policy.model_copy(update={"read_timeout_s": 0.5})  # this server keeps its end open, whatever it is asked
    with open_gate(soon) as gate:
        answer = ask(gate, server.file("/a", b"body", Connection="keep-alive"))
    head, _, body = answer.partition(b"\r\n\r\n")
    lines = head.split(b"\r\n")
    assert lines[0] == b"HTTP/1.1 200 OK" and body == b"body"
    assert next(line for line in lines if line.startswith(b"Connection:")) == b"Connection: close"


def test_a_chain_of_redirects_never_meets_a_closed_connection(server: Served, policy: SourcePolicy) -> None:
    for i in range(30):
        server.redirect(f"/{i}", f"/{i + 1}")
    server.file("/30", b"there")
    with open_gate(policy) as gate, httpx.Client(proxy=gate.url, follow_redirects=True, max_redirects=40) as client:
        assert client.get(server.url("/0")).content == b"there"


@pytest.mark.parametrize("sent", [b"", b"HTTP/1.1 20"])
def test_a_server_that_hangs_up_before_its_first_line_is_a_bad_gateway(
    server: Served, policy: SourcePolicy, sent: bytes
) -> None:
    def hang_up(handler: Handler) -> None:
        handler.wfile.write(sent)
        handler.close_connection = True

    server.answers["/a"] = hang_up
    with open_gate(policy) as gate:
        assert ask(gate, server.url("/a")).startswith(b"HTTP/1.1 502 ")


def test_a_first_line_in_pieces_is_put_together(server: Served, policy: SourcePolicy) -> None:
    def dribble(handler: Handler) -> None:
        for byte in b"HTTP/1.1 200 OK\r\nContent-Length: 2\r\n\r\nhi":
            handler.wfile.write(bytes([byte]))
            handler.wfile.flush()
        handler.close_connection = True

    server.answers["/a"] = dribble
    with open_gate(policy) as gate:
        answer = ask(gate, server.url("/a"))
    assert answer == b"HTTP/1.1 200 OK\r\nConnection: close\r\nContent-Length: 2\r\n\r\nhi"
