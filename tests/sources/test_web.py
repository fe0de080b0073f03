"""http(s) downloads against a real server that breaks off, lies, stalls and sends too much."""

from __future__ import annotations

import gzip
import logging
import threading
import time
from pathlib import Path

import pytest

from tasks.errors import (
    BadInputError,
    MissingSourceError,
    RefusedSourceError,
    TransientError,
    UnusableSourceError,
    is_transient,
)
from tasks.sources import SourcePolicy, fetch_source

from .server import Handler, Served


def fails(url: str, policy: SourcePolicy, cache: Path, kind: type[Exception], words: str) -> Exception:
    with pytest.raises(kind, match=words) as caught:
        fetch_source(url, policy, cache)
    assert "expected" in str(caught.value) and "got" in str(caught.value)
    return caught.value


def changed(policy: SourcePolicy, **values: object) -> SourcePolicy:
    return policy.model_copy(update=values)


def test_a_video_comes_whole_and_is_known_by_its_content(
    server: Served, clip: bytes, policy: SourcePolicy, cache: Path, tmp_path: Path
) -> None:
    (tmp_path / "same.mp4").write_bytes(clip)
    url = server.file("/My%20clip.mp4", clip) + "?quality=high"
    source = fetch_source(url, policy, cache)
    assert source.path.read_bytes() == clip
    assert (source.name, source.origin) == ("My-clip", url)
    assert source.content_hash == fetch_source(str(tmp_path / "same.mp4"), policy, cache).content_hash


def test_an_unchanged_video_is_asked_about_and_not_sent_again(
    server: Served, clip: bytes, policy: SourcePolicy, cache: Path
) -> None:
    url = server.file("/a.mp4", clip, ETag='"one"')
    first = fetch_source(url, policy, cache)
    assert fetch_source(url, policy, cache) == first
    assert server.requests[-1].headers["if-none-match"] == '"one"'
    assert server.asked("/a.mp4") == 2


def test_a_changed_video_is_fetched_anew(server: Served, clip: bytes, policy: SourcePolicy, cache: Path) -> None:
    first = fetch_source(server.file("/a.mp4", clip, ETag='"one"'), policy, cache)
    second = fetch_source(server.file("/a.mp4", clip + b"more", ETag='"two"'), policy, cache)
    assert second.path.read_bytes() == clip + b"more" and second.content_hash != first.content_hash


def test_a_truncated_copy_in_the_cache_is_made_good(
    server: Served, clip: bytes, policy: SourcePolicy, cache: Path
) -> None:
    url = server.file("/a.mp4", clip, ETag='"one"')
    path = fetch_source(url, policy, cache).path
    path.write_bytes(clip[:100])
    assert fetch_source(url, policy, cache).path.read_bytes() == clip


def breaks_off(server: Served, clip: bytes, at: list[int], etag: str | None = '"one"') -> str:
    """Send `at[0]` bytes of what is asked for and hang up, next time `at[1]` more, ..., then all."""
    cuts = list(at)
    headers = {"ETag": etag} if etag else {}

    def answer(handler: Handler) -> None:
        asked = handler.headers.get("Range")
        start = int(asked.removeprefix("bytes=").rstrip("-")) if asked and etag else 0
        place = {"Content_Range": f"bytes {start}-{len(clip) - 1}/{len(clip)}"} if start else {}
        body = clip[start:]
        if not cuts:
            handler.reply(206 if start else 200, body, **place, **headers)
            return
        handler.reply(206 if start else 200, body[: cuts.pop(0)], Content_Length=str(len(body)), **place, **headers)
        handler.close_connection = True

    server.answers["/a.mp4"] = answer
    return server.url("/a.mp4")


def test_a_broken_download_goes_on_where_it_stopped(
    server: Served, clip: bytes, policy: SourcePolicy, cache: Path
) -> None:
    source = fetch_source(breaks_off(server, clip, [1000, 2000]), policy, cache)
    assert source.path.read_bytes() == clip
    assert [r.headers.get("range") for r in server.requests] == [None, "bytes=1000-", "bytes=3000-"]
    assert server.requests[-1].headers["if-range"] == '"one"'


def test_a_later_run_goes_on_where_a_failed_one_stopped(
    server: Served, clip: bytes, policy: SourcePolicy, cache: Path
) -> None:
    url = breaks_off(server, clip, [1000, 1000, 1000])
    error = fails(url, policy, cache, TransientError, "3 tries")
    assert is_transient(error)
    assert fetch_source(url, policy, cache).path.read_bytes() == clip
    assert server.requests[-1].headers["range"] == "bytes=3000-"


def test_without_a_validator_a_broken_download_starts_anew(
    server: Served, clip: bytes, policy: SourcePolicy, cache: Path
) -> None:
    source = fetch_source(breaks_off(server, clip, [1000], etag=None), policy, cache)
    assert source.path.read_bytes() == clip
    assert all("range" not in request.headers for request in server.requests)


def test_a_file_that_changes_between_two_tries_is_not_glued_together(
    server: Served, clip: bytes, policy: SourcePolicy, cache: Path
) -> None:
    other = bytes(reversed(clip[200:])) + clip[:200]
    other = clip[:64] + other

    def first(handler: Handler) -> None:
        server.file("/a.mp4", other, ETag='"two"')
        handler.reply(200, clip[:5000], Content_Length=str(len(clip)), ETag='"one"')
        handler.close_connection = True

    server.answers["/a.mp4"] = first
    assert fetch_source(server.url("/a.mp4"), policy, cache).path.read_bytes() == other


def test_the_wrong_part_is_not_glued_on(server: Served, clip: bytes, policy: SourcePolicy, cache: Path) -> None:
    def second(handler: Handler) -> None:
        server.file("/a.mp4", clip, ETag='"one"')
        place = f"bytes 500-{len(clip) - 1}/{len(clip)}"
        handler.reply(206, clip[500:], Content_Range=place, ETag='"one"')

    def first(handler: Handler) -> None:
        server.answers["/a.mp4"] = second
        handler.reply(200, clip[:1000], Content_Length=str(len(clip)), ETag='"one"')
        handler.close_connection = True

    server.answers["/a.mp4"] = first
    assert fetch_source(server.url("/a.mp4"), policy, cache).path.read_bytes() == clip


@pytest.mark.parametrize("status", [408, 429, 500, 502, 503, 504])
def test_a_busy_server_is_tried_again(
    server: Served, clip: bytes, policy: SourcePolicy, cache: Path, status: int
) -> None:
    def busy(handler: Handler) -> None:
        if server.asked("/a.mp4") == 2:
            server.file("/a.mp4", clip)
        handler.reply(status, Retry_After="0")

    server.answers["/a.mp4"] = busy
    assert fetch_source(server.url("/a.mp4"), policy, cache).path.read_bytes() == clip
    assert server.asked("/a.mp4") == 3


@pytest.mark.parametrize(
    ("status", "kind"),
    [(401, MissingSourceError), (403, MissingSourceError), (404, MissingSourceError), (410, MissingSourceError),
     (418, UnusableSourceError)],
)  # fmt: skip
def test_a_final_answer_is_not_asked_for_twice(
    server: Served, policy: SourcePolicy, cache: Path, status: int, kind: type[BadInputError]
) -> None:
    server.answers["/a.mp4"] = lambda handler: handler.reply(status)
    error = fails(server.url("/a.mp4"), policy, cache, kind, str(status))
    assert not is_transient(error) and server.asked("/a.mp4") == 1


def test_a_server_that_stalls_is_given_up_and_tried_again(
    server: Served, clip: bytes, policy: SourcePolicy, cache: Path
) -> None:
    release = threading.Event()

    def stalls(handler: Handler) -> None:
        server.file("/a.mp4", clip, ETag='"one"')
        handler.reply(200, clip[:1000], Content_Length=str(len(clip)), ETag='"one"')
        handler.wfile.flush()
        release.wait(10)

    server.answers["/a.mp4"] = stalls
    impatient = changed(policy, read_timeout_s=0.5, attempts=20)
    try:
        assert fetch_source(server.url("/a.mp4"), impatient, cache).path.read_bytes() == clip
    finally:
        release.set()
    assert server.requests[-1].headers["range"] == "bytes=1000-"


def test_a_server_that_drips_does_not_hold_a_worker_for_ever(
    server: Served, clip: bytes, policy: SourcePolicy, cache: Path
) -> None:
    def drips(handler: Handler) -> None:
        handler.reply(200, b"", Content_Length=str(len(clip)))
        for byte in clip[:100]:
            handler.wfile.write(bytes([byte]))
            handler.wfile.flush()
            time.sleep(0.02)

    server.answers["/a.mp4"] = drips
    slow = changed(policy, total_timeout_s=0.2)
    error = fails(server.url("/a.mp4"), slow, cache, TransientError, "TOTAL_TIMEOUT_S")
    assert is_transient(error)


def test_a_port_nobody_listens_on_is_transient(policy: SourcePolicy, cache: Path) -> None:
    error = fails("http://127.0.0.1:1/a.mp4", policy, cache, TransientError, "try")
    assert is_transient(error)


@pytest.mark.parametrize("announced", [True, False])
def test_too_large_a_video_is_refused_as_soon_as_that_shows(
    server: Served, clip: bytes, policy: SourcePolicy, cache: Path, announced: bool
) -> None:
    sent: list[int] = []

    def answer(handler: Handler) -> None:
        if announced:
            handler.reply(200, clip)
            return
        handler.send_response(200)
        handler.send_header("Transfer-Encoding", "chunked")
        handler.end_headers()
        for _ in range(2000):  # without an end in sight
            handler.wfile.write(b"10000\r\n" + (clip * 9)[:0x10000] + b"\r\n")
            sent.append(0x10000)

    server.answers["/a.mp4"] = answer
    small = changed(policy, max_bytes=len(clip) - 1)
    fails(server.url("/a.mp4"), small, cache, RefusedSourceError, "MAX_BYTES")
    assert server.asked("/a.mp4") == 1
    assert sum(sent) < 2000 * 0x10000
    assert not [path for path in cache.rglob("*") if path.is_file() and path.stat().st_size > 1000]


@pytest.mark.parametrize(
    ("body", "words"),
    [
        (b"<!DOCTYPE html><html><video src=x></html>" * 30, "a web page"),
        (b"\n  <HTML>", "a web page"),
        (b"#EXTM3U\n#EXTINF:1,\nhttp://127.0.0.1/\n", "names other files"),
        (b"\x89PNG\r\n\x1a\n" + bytes(600), "a PNG picture"),
        (b"PK\x03\x04" + bytes(600), "a zip archive"),
        (b'{"error": "gone"}', "JSON"),
        (b"hello there\n" * 100, "text"),
        (b"", "empty"),
    ],
)
def test_what_is_no_video_is_told_by_its_content_whatever_the_server_says(
    server: Served, policy: SourcePolicy, cache: Path, body: bytes, words: str
) -> None:
    url = server.file("/clip.mp4", body, Content_Type="video/mp4")
    fails(url, policy, cache, UnusableSourceError, words)
    assert server.asked("/clip.mp4") == 1


def test_a_video_is_taken_whatever_the_server_calls_it(
    server: Served, clip: bytes, policy: SourcePolicy, cache: Path
) -> None:
    url = server.file("/page.html", clip, Content_Type="text/html")
    assert fetch_source(url, policy, cache).path.read_bytes() == clip


def test_a_compressed_answer_is_refused_before_it_can_swell(
    server: Served, clip: bytes, policy: SourcePolicy, cache: Path
) -> None:
    url = server.file("/a.mp4", gzip.compress(bytes(10**6)), Content_Encoding="gzip")
    fails(url, policy, cache, UnusableSourceError, "compressed")
    assert server.requests[0].headers["accept-encoding"] == "identity"


def test_a_download_keeps_to_its_rate(
    server: Served, clip: bytes, policy: SourcePolicy, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    slept: list[float] = []
    monkeypatch.setattr("tasks.sources.copying.time.sleep", slept.append)
    monkeypatch.setattr("tasks.sources.copying.time.monotonic", lambda: 0.0)
    fetch_source(server.file("/a.mp4", clip), changed(policy, max_bytes_per_s=1000), cache)
    assert max(slept) == pytest.approx(len(clip) / 1000)


def test_two_workers_on_one_machine_fetch_a_video_once(
    server: Served, clip: bytes, policy: SourcePolicy, cache: Path
) -> None:
    url = server.file("/a.mp4", clip, ETag='"one"')
    found: list[bytes] = []
    threads = [
        threading.Thread(target=lambda: found.append(fetch_source(url, policy, cache).path.read_bytes()))
        for _ in range(4)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == [clip] * 4
    assert sum("if-none-match" not in request.headers for request in server.requests) == 1


def test_the_copy_here_serves_while_the_server_is_away(
    server: Served, clip: bytes, policy: SourcePolicy, cache: Path, caplog: pytest.LogCaptureFixture
) -> None:
    url = server.file("/a.mp4", clip, ETag='"one"')
    fetch_source(url, policy, cache)
    server.answers["/a.mp4"] = lambda handler: handler.reply(503)
    with caplog.at_level(logging.WARNING):
        assert fetch_source(url, policy, cache).path.read_bytes() == clip
    assert "copy on this machine" in caplog.text


def test_a_video_that_was_taken_down_is_not_served_from_the_cache(
    server: Served, clip: bytes, policy: SourcePolicy, cache: Path
) -> None:
    url = server.file("/a.mp4", clip, ETag='"one"')
    fetch_source(url, policy, cache)
    server.answers["/a.mp4"] = lambda handler: handler.reply(410)
    fails(url, policy, cache, MissingSourceError, "410")


def test_redirects_are_followed_and_counted(server: Served, clip: bytes, policy: SourcePolicy, cache: Path) -> None:
    server.file("/there.mp4", clip)
    server.redirect("/two", "/there.mp4", 307)
    assert fetch_source(server.redirect("/one", server.url("/two")), policy, cache).path.read_bytes() == clip
    fails(server.redirect("/round", "/round"), policy, cache, UnusableSourceError, "redirects")
    assert server.asked("/round") == policy.max_redirects + 1
