"""Titles and file names with markup, separators or worse become harmless names, and never HTML or paths."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flows.request import VideoRequest
from tasks.sources import SourcePolicy, fetch_source, safe_name, source_name

HARMLESS = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,39}")
HOSTILE = [
    "<img src=x onerror=alert(1)>.mp4",
    "a b/../../etc/passwd",
    "..",
    "...",
    "-rf",
    ".hidden",
    "[click](javascript:alert(1)).mp4",
    "`rm -rf`;$(id).mp4",
    "CON\\aux.mp4",
    "{{ 7*7 }}.mp4",
    "видео.mp4",
    "😀",
    "%2e%2e%2f",
    "",
]


@pytest.mark.parametrize("title", HOSTILE)
def test_hostile_titles_become_harmless_names(title: str) -> None:
    assert HARMLESS.fullmatch(safe_name(title)) and ".." not in Path(safe_name(title)).parts


@given(st.text(max_size=200))
def test_every_text_becomes_a_harmless_name(text: str) -> None:
    for name in (safe_name(text), source_name(text), source_name("https://example.org/" + text)):
        assert HARMLESS.fullmatch(name)
        assert (Path("/out") / name).resolve().parent == Path("/out")


def test_a_video_with_markup_in_its_name_gets_a_harmless_id(tmp_path: Path, clip: bytes) -> None:
    path = tmp_path / "<b>me & \"you\"</b>'$(id)' .mp4".replace("/", "\u2044")
    path.write_bytes(clip)
    source = fetch_source(str(path), SourcePolicy(), tmp_path / "cache")
    request = VideoRequest(video=str(path), out=str(tmp_path / "out"), store="memory://security-names")
    run = request.run(request.id_of(source), observer=None)  # type: ignore[arg-type]
    assert re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]*", run.video_id)


def test_the_report_escapes_whatever_it_is_given() -> None:
    from tasks.report import page_environment

    page = page_environment().from_string("{{ title }}").render(title="<script>alert(1)</script>")
    assert "<script>" not in page and "&lt;script&gt;" in page
