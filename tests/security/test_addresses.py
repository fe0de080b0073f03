"""Connections go to checked addresses only: names, redirects, rebinding, proxies of the environment."""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from tasks.errors import MissingSourceError, RefusedSourceError, TransientError, is_transient
from tasks.sources import SourcePolicy, fetch_source
from tasks.sources.address import connect, refusal, resolve
from tests.sources.server import Served, serving

NOWHERE = "203.0.113.7"  # reserved for documentation, so "not public" for the check
PUBLIC = "93.184.216.34"


class Names:
    """Name resolution as a hostile server of names would do it: the answers of one name, one after the other."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.answers: dict[str, list[list[str]]] = {}
        self.asked: list[str] = []
        self._real = socket.getaddrinfo
        monkeypatch.setattr(socket, "getaddrinfo", self._lookup)

    def _lookup(self, host, port, *args, **kwargs):  # type: ignore[no-untyped-def]
        name = host.decode() if isinstance(host, bytes) else host
        if name not in self.answers:
            return self._real(host, port, *args, **kwargs)
        self.asked.append(name)
        answers = self.answers[name]
        addresses = answers.pop(0) if len(answers) > 1 else answers[0]
        family = {True: socket.AF_INET6, False: socket.AF_INET}
        return [(family[":" in a], socket.SOCK_STREAM, 6, "", (a, port)) for a in addresses]


@pytest.fixture
def names(monkeypatch: pytest.MonkeyPatch) -> Names:
    return Names(monkeypatch)


@pytest.fixture
def other(clip: bytes) -> Iterator[Served]:
    """A second server, at another loopback address: a stand-in for a machine inside the network."""
    with serving("127.0.0.2") as served:
        served.file("/secret.mp4", clip)
        yield served


@pytest.mark.parametrize("address", ["127.0.0.1", "10.1.2.3", "169.254.169.254", "::1", "fd00::1", "::ffff:10.0.0.1"])
def test_a_name_that_leads_inside_is_refused(names: Names, cache: Path, address: str) -> None:
    names.answers["innocent.example"] = [[address]]
    with pytest.raises(RefusedSourceError, match="PRIVATE_HOSTS"):
        fetch_source("http://innocent.example/a.mp4", SourcePolicy(), cache)
    names.answers["innocent.example"] = [[PUBLIC, address]]
    with pytest.raises(RefusedSourceError, match="PRIVATE_HOSTS"):
        resolve("innocent.example", 80, SourcePolicy())


def test_rebinding_does_not_slip_through(
    names: Names, server: Served, clip: bytes, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first answer counts as public, every later one is this machine; whoever looks twice connects inside."""
    public = ipaddress.ip_address("127.0.0.2")  # nobody listens there on this port, and no test talks to real strangers
    monkeypatch.setattr("tasks.sources.address.refusal", lambda a: None if a == public else refusal(a))
    server.file("/a.mp4", clip)
    names.answers["rebind.example"] = [[str(public)], ["127.0.0.1"]]
    with pytest.raises(TransientError):
        fetch_source(f"http://rebind.example:{server.port}/a.mp4", SourcePolicy(attempts=1), cache)
    assert server.requests == [] and names.asked == ["rebind.example"]


def test_the_connection_goes_to_the_address_that_was_checked(
    names: Names, server: Served, clip: bytes, policy: SourcePolicy, cache: Path
) -> None:
    names.answers["allowed.example"] = [["127.0.0.1"], [NOWHERE]]
    allowed = policy.model_copy(update={"private_hosts": ("allowed.example",)})
    server.file("/a.mp4", clip)
    fetch_source(f"http://allowed.example:{server.port}/a.mp4", allowed, cache)
    assert server.requests[0].headers["host"] == f"allowed.example:{server.port}"
    assert names.asked == ["allowed.example"]


@pytest.mark.parametrize("status", [301, 302, 303, 307, 308])
def test_every_redirect_is_checked_again(
    server: Served, other: Served, policy: SourcePolicy, cache: Path, status: int
) -> None:
    url = server.redirect("/a.mp4", other.url("/secret.mp4", "127.0.0.2"), status)
    with pytest.raises(RefusedSourceError, match=r"127\.0\.0\.2"):
        fetch_source(url, policy, cache)
    assert other.requests == []


@pytest.mark.parametrize(
    "location",
    ["file:///etc/passwd", "ftp://example.org/a", "http://[::1]/a", "http://2130706433/a", "javascript:alert(1)",
     "http://169.254.169.254/latest/meta-data/iam/security-credentials/", "http://user:pw@[/",
     "//127.0.0.2/secret.mp4"],
)  # fmt: skip
def test_a_redirect_leads_nowhere_that_a_list_could_not(
    server: Served, other: Served, policy: SourcePolicy, cache: Path, location: str
) -> None:
    with pytest.raises(ValueError, match="expected"):
        fetch_source(server.redirect("/a.mp4", location), policy, cache)
    assert len(server.requests) == 1 and other.requests == []


def test_a_redirect_to_a_name_that_leads_inside_is_refused(
    names: Names, server: Served, other: Served, policy: SourcePolicy, cache: Path
) -> None:
    names.answers["innocent.example"] = [["127.0.0.2"]]
    url = server.redirect("/a.mp4", other.url("/secret.mp4", "innocent.example"))
    with pytest.raises(RefusedSourceError, match="innocent"):
        fetch_source(url, policy, cache)
    assert other.requests == []


def test_credentials_do_not_follow_a_redirect(
    server: Served, clip: bytes, policy: SourcePolicy, cache: Path, tmp_path: Path
) -> None:
    (tmp_path / "netrc").write_text("machine 127.0.0.1\nlogin me\npassword geheim\n")
    with serving("127.0.0.2") as stranger:
        stranger.file("/a.mp4", clip)
        trusting = policy.model_copy(update={"netrc": tmp_path / "netrc", "private_hosts": ("127.0.0.1", "127.0.0.2")})
        url = server.redirect("/a.mp4", stranger.url("/a.mp4", "127.0.0.2"))
        source = fetch_source(url, trusting, cache)
        assert server.requests[0].headers["authorization"].startswith("Basic ")
        assert "authorization" not in stranger.requests[0].headers
    assert "geheim" not in source.origin


def test_a_proxy_of_the_environment_is_not_used(
    server: Served, other: Served, clip: bytes, policy: SourcePolicy, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A proxy would look names up by itself, where nothing is checked."""
    for name in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.setenv(name, other.url())
    fetch_source(server.file("/a.mp4", clip), policy, cache)
    assert other.requests == [] and len(server.requests) == 1


def test_failing_look_ups_are_told_apart(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(code: int):  # type: ignore[no-untyped-def]
        def lookup(*args: object, **kwargs: object) -> None:
            raise socket.gaierror(code, "no answer")

        return lookup

    monkeypatch.setattr(socket, "getaddrinfo", fail(socket.EAI_AGAIN))
    with pytest.raises(TransientError) as caught:
        connect("somewhere.example", 80, SourcePolicy())
    assert is_transient(caught.value)
    monkeypatch.setattr(socket, "getaddrinfo", fail(socket.EAI_NONAME))
    with pytest.raises(MissingSourceError) as gone:
        connect("somewhere.example", 80, SourcePolicy())
    assert not is_transient(gone.value)
