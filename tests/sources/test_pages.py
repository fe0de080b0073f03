"""Pages through yt-dlp's generic extractor and a real server: the gate, limits, errors, cookies, the archive."""

from __future__ import annotations

from pathlib import Path

import pytest

from flows.lists import read_list
from tasks.errors import (
    MissingExtraError,
    MissingSourceError,
    RefusedSourceError,
    TransientError,
    UnusableSourceError,
)
from tasks.sources import SourcePolicy, fetch_source

from .server import Handler, Served

pytest.importorskip("yt_dlp", reason="needs the extra ahoy[youtube]")

HOSTILE_TITLE = "../../<script>alert(1)</script>%(id)s\\..\\x"


@pytest.fixture
def pages(policy: SourcePolicy) -> SourcePolicy:
    return policy.model_copy(update={"page_hosts": ("127.0.0.1",), "attempts": 2})


def page(server: Served, video: str, path: str = "/page", title: str = "A walk") -> str:
    html = f'<html><head><title>{title}</title></head><body><video src="{video}"></video></body></html>'
    return server.file(path, html.encode(), Content_Type="text/html")


def test_the_video_of_a_page_is_fetched_once(server: Served, clip: bytes, pages: SourcePolicy, cache: Path) -> None:
    url = page(server, server.file("/a.mp4", clip, Content_Type="video/mp4"))
    source = fetch_source(url, pages, cache)
    assert source.path.read_bytes() == clip and source.origin == url
    before = len(server.requests)
    assert fetch_source(url, pages, cache) == source and len(server.requests) == before


def test_a_title_never_becomes_a_path(server: Served, clip: bytes, pages: SourcePolicy, cache: Path) -> None:
    url = page(server, server.file("/a.mp4", clip, Content_Type="video/mp4"), title=HOSTILE_TITLE)
    source = fetch_source(url, pages, cache)
    assert source.path.is_relative_to(cache) and source.name == "page"
    files = {path.relative_to(cache).parts[-1] for path in cache.parent.rglob("*") if path.is_file()}
    assert files <= {"video", "video.json"} | {name for name in files if name.endswith(".lock")}


def test_a_page_that_leads_inside_the_network_is_refused_and_never_asked(
    server: Served, clip: bytes, pages: SourcePolicy, cache: Path
) -> None:
    secret = server.file("/secret.mp4", clip, Content_Type="video/mp4")
    inside = secret.replace("127.0.0.1", "127.0.0.2")
    with pytest.raises(RefusedSourceError, match=r"127\.0\.0\.2"):
        fetch_source(page(server, inside), pages, cache)
    with pytest.raises(RefusedSourceError, match="this machine itself"):
        fetch_source(page(server, server.redirect("/hop.mp4", inside), "/page2"), pages, cache)
    assert server.asked("/secret.mp4") == 0


def test_a_video_that_is_too_large_is_refused(server: Served, clip: bytes, pages: SourcePolicy, cache: Path) -> None:
    url = page(server, server.file("/a.mp4", clip, Content_Type="video/mp4"))
    with pytest.raises((RefusedSourceError, UnusableSourceError), match="MAX_BYTES"):
        fetch_source(url, pages.model_copy(update={"max_bytes": 1000}), cache)


def test_a_page_without_a_video_and_one_with_several_are_bad_input(
    server: Served, clip: bytes, pages: SourcePolicy, cache: Path
) -> None:
    with pytest.raises((UnusableSourceError, MissingSourceError), match="expected a page with a video"):
        fetch_source(
            server.file("/empty", b"<html><body>nothing</body></html>", Content_Type="text/html"), pages, cache
        )
    for name in ("/a.mp4", "/b.mp4"):
        server.file(name, clip, Content_Type="video/mp4")
    html = b'<html><title>x</title><video src="/a.mp4"></video><video src="/b.mp4"></video></html>'
    with pytest.raises(UnusableSourceError, match="several"):
        fetch_source(server.file("/two", html, Content_Type="text/html"), pages, cache)


def test_a_playlist_behind_a_page_is_not_handed_to_a_program(
    server: Served, clip: bytes, pages: SourcePolicy, cache: Path
) -> None:
    """HLS would be fetched by an FFmpeg program where there is one, around the gate."""
    server.file("/secret.ts", clip)
    playlist = f"#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\n{server.url('/secret.ts')}\n#EXT-X-ENDLIST\n"
    url = page(server, server.file("/v.m3u8", playlist.encode(), Content_Type="application/vnd.apple.mpegurl"))
    with pytest.raises((UnusableSourceError, MissingSourceError)):
        fetch_source(url, pages, cache)
    assert server.asked("/secret.ts") == 0


@pytest.mark.parametrize(("status", "kind"), [(503, TransientError), (429, TransientError), (404, MissingSourceError)])
def test_an_answer_of_the_page_is_judged_by_its_status(
    server: Served, pages: SourcePolicy, cache: Path, status: int, kind: type[Exception]
) -> None:
    server.answers["/page"] = lambda handler: handler.reply(status)
    with pytest.raises(kind, match=str(status)):
        fetch_source(server.url("/page"), pages, cache)


def test_a_server_that_is_away_is_transient(pages: SourcePolicy, cache: Path) -> None:
    with pytest.raises(TransientError, match="tries"):
        fetch_source("http://127.0.0.1:1/page", pages, cache)


def test_cookies_are_sent_and_the_file_stays_as_it_was(
    server: Served, clip: bytes, pages: SourcePolicy, cache: Path, tmp_path: Path
) -> None:
    jar = tmp_path / "cookies.txt"
    jar.write_text("# Netscape HTTP Cookie File\n127.0.0.1\tFALSE\t/\tFALSE\t0\tsession\tabc123\n")
    before = jar.read_bytes()
    server.file("/a.mp4", clip, Content_Type="video/mp4", Set_Cookie="other=1")
    fetch_source(page(server, server.url("/a.mp4")), pages.model_copy(update={"cookies": jar}), cache)
    assert "session=abc123" in server.requests[-1].headers["cookie"]
    assert jar.read_bytes() == before
    assert not list(cache.rglob("cookies*"))


def test_what_was_fetched_is_noted_in_yt_dlps_archive_and_rerun_all_the_same(
    server: Served, clip: bytes, pages: SourcePolicy, cache: Path, tmp_path: Path
) -> None:
    noting = pages.model_copy(update={"archive": tmp_path / "archive.txt"})
    url = page(server, server.file("/a.mp4", clip, Content_Type="video/mp4"))
    for folder in ("one", "two"):
        fetch_source(url, noting, cache / folder)
    lines = (tmp_path / "archive.txt").read_text().splitlines()
    assert len(lines) == 1 and lines[0] == "html5mediaembed page-1"
    assert len(read_list("-", noting, stdin=[url.encode()]).entries) == 1


def test_without_yt_dlp_the_extra_is_named(
    server: Served, pages: SourcePolicy, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "yt_dlp", None)
    with pytest.raises(MissingExtraError, match="youtube"):
        fetch_source(server.url("/page"), pages, cache)


def test_a_download_that_breaks_off_is_tried_again(
    server: Served, clip: bytes, pages: SourcePolicy, cache: Path
) -> None:
    def breaks(handler: Handler) -> None:
        if server.asked("/a.mp4") >= 3:
            server.file("/a.mp4", clip, Content_Type="video/mp4")
        handler.reply(200, clip[:2000], Content_Length=str(len(clip)), Content_Type="video/mp4")
        handler.close_connection = True

    server.answers["/a.mp4"] = breaks
    assert fetch_source(page(server, server.url("/a.mp4")), pages, cache).path.read_bytes() == clip
