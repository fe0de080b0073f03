"""Hostile lines of a list: each is reported with its number and does not go in, and the good ones do."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from flows.lists import VideoList, read_list
from tasks.sources import SourcePolicy

GOOD = "https://example.org/good.mp4"
REMOTE_ONLY = SourcePolicy(local=False)


def read(lines: list[str | bytes], policy: SourcePolicy, folder: Path) -> VideoList:
    raw = [
        line if isinstance(line, bytes) else line.encode("utf-8", "surrogatepass")
        for line in [GOOD, *lines, GOOD + "?2"]
    ]
    (folder / "list.txt").write_bytes(b"\n".join(raw))
    videos = read_list(folder / "list.txt", policy)
    assert [entry.source for entry in videos.entries] == [GOOD, GOOD + "?2"], "the good lines go in"
    assert [problem.line for problem in videos.problems] == list(range(2, 2 + len(lines)))
    assert all(len(problem.text) < 200 and problem.text.isprintable() for problem in videos.problems)
    assert all(len(problem.reason) < 600 and problem.reason.isprintable() for problem in videos.problems)
    return videos


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("-rf", "option"),
        ("--exec rm", "option"),
        ("--config-locations=/tmp/x", "option"),
        ("../secret.mp4", "list's own folder"),
        ("sub/../../secret.mp4", "list's own folder"),
        ("./../secret.mp4", "list's own folder"),
        ("https://example.org/" + "a" * 10_000, "characters"),
        ("a" * 10_000, "characters"),
        ("clip\0.mp4", "U+0000"),
        ("https://example.org/\x1b[31mred.mp4", "U+001B"),
        ("https://example.org/a\rSet-Cookie: x", "U+000D"),
        ("clip\u202e4pm.exe", "U+202E"),
        (b"caf\xe9.mp4", "UTF-8"),
        ("javascript://example.org/%0aalert(1)", "expected a path"),
        ("gopher://example.org/", "expected a path"),
        ("ftp://example.org/a.mp4", "expected a path"),
        ("data://text/plain,x", "expected a path"),
        ("concat://a|b", "expected a path"),
        ("memory://box/a.mp4", "expected a path"),
        ("simplecache::http://127.0.0.1/a.mp4", "chain"),
        ("zip://*::file:///etc/passwd", "chain"),
        ("s3://bucket/a::http://127.0.0.1/a.mp4", "chain"),
        ("s3://bucket/../other/a.mp4", "full address"),
        ("s3://", "full address"),
        ("file://host/etc/passwd", "another machine"),
        ("file:///etc/passwd%00.mp4", "U+0000"),
        ("https:///a.mp4", "host"),
        ("https://[::1/a.mp4", "http(s) address"),
        ("https://example.org\\.example.com/a.mp4", "backslashes"),
        ("https://example.org:99999999/a.mp4", "http(s) address"),
        ("https://user:word@example.org/a.mp4", "credentials"),
        ("https://example.org/a.mp4?X-Amz-Signature=abc", "credentials"),
        ("https://www.youtube.com/playlist?list=PL123", "playlist"),
        ("https://www.youtube.com/@somebody", "channel"),
    ],
)  # fmt: skip
def test_a_hostile_line_is_reported_and_left_out(tmp_path: Path, line: str | bytes, words: str) -> None:
    assert words in read([line], SourcePolicy(), tmp_path).problems[0].reason


@pytest.mark.parametrize("line", ["file:///etc/hostname", "/etc/hostname", "clip.mp4", "./clip.mp4"])
def test_local_files_are_refused_when_only_remote_ones_are_allowed(tmp_path: Path, line: str) -> None:
    (tmp_path / "clip.mp4").write_bytes(b"x")
    assert "not allowed" in read([line], REMOTE_ONLY, tmp_path).problems[0].reason


def test_files_outside_the_root_are_refused_also_through_links(tmp_path: Path) -> None:
    root, outside = tmp_path / "root", tmp_path / "outside"
    for folder in (root, outside):
        folder.mkdir()
    (outside / "a.mp4").write_bytes(b"x")
    (root / "link.mp4").symlink_to(outside / "a.mp4")
    (root / "folder").symlink_to(outside)
    lines = ["link.mp4", "folder/a.mp4", str(outside / "a.mp4"), f"file://{outside}/a.mp4", "/etc/hostname"]
    videos = read(lines, SourcePolicy(local_root=root), root)
    assert all("lies elsewhere" in problem.reason for problem in videos.problems)


@pytest.mark.parametrize(
    "host",
    [
        "127.0.0.1", "127.1", "2130706433", "0x7f000001", "localhost", "LOCALHOST", "a.localhost", "localhost.",
        "10.0.0.1", "172.16.0.1", "192.168.1.1", "169.254.169.254", "100.64.0.1", "0.0.0.0", "224.0.0.1",
        "255.255.255.255",
        "[::1]", "[::]", "[fe80::1]", "[fc00::1]", "[::ffff:10.0.0.1]", "[::ffff:7f00:1]", "[64:ff9b::a00:1]",
        "[2002:7f00:1::]", "[::127.0.0.1]", "[ff02::1]", "127.0.0.1.",
    ],
)  # fmt: skip
def test_addresses_inside_the_network_are_refused_in_every_spelling(tmp_path: Path, host: str) -> None:
    reason = (
        read([f"http://{host}/latest/meta-data", f"https://{host}:8443/"], SourcePolicy(), tmp_path).problems[0].reason
    )
    assert "public address" in reason and "PRIVATE_HOSTS" in reason


@pytest.mark.parametrize(
    "host", ["0177.0.0.1", "１２７.0.0.1", "127.0.0.1%00.example.org", "example.org%2f@127.0.0.1", "0"]
)
def test_hosts_that_parsers_read_differently_are_refused(tmp_path: Path, host: str) -> None:
    read([f"http://{host}/a.mp4"], SourcePolicy(), tmp_path)


def test_public_addresses_are_not_refused(tmp_path: Path) -> None:
    lines = ["http://93.184.216.34/a.mp4", "https://[2606:2800:220:1::1]/a.mp4", "https://xn--bcher-kva.example/a.mp4"]
    (tmp_path / "list.txt").write_text("\n".join(lines))
    assert not read_list(tmp_path / "list.txt", SourcePolicy()).problems


def test_an_allowed_host_is_allowed_and_no_other(tmp_path: Path) -> None:
    policy = SourcePolicy(private_hosts=("10.0.0.1",))
    (tmp_path / "list.txt").write_text("http://10.0.0.1/a.mp4\nhttp://10.0.0.2/a.mp4\n")
    videos = read_list(tmp_path / "list.txt", policy)
    assert [entry.line for entry in videos.entries] == [1] and [p.line for p in videos.problems] == [2]


@pytest.mark.parametrize("line", ["a" * 2_000_000, "://" * 500_000, "?a=" * 500_000, "x?" * 800_000, "a.b-" * 500_000])
def test_a_line_of_megabytes_costs_linear_time(tmp_path: Path, line: str) -> None:
    """A quadratic pattern would take hours here; the suite's own timeout is what this can fail by."""
    started = time.process_time()
    read([line], SourcePolicy(), tmp_path)
    assert time.process_time() - started < 60
