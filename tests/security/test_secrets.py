"""Credentials show up nowhere: not in messages, logs, names, problems of lists, or what is kept of a source."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flows.lists import read_list
from flows.request import VideoRequest
from tasks.sources import SourcePolicy, fetch_source, redact, shown, source_name
from tests.sources.server import Served

SECRET = "s3cr3t-Word"
CARRIERS = [
    "https://me:{}@example.org/a.mp4",
    "https://{}@example.org/a.mp4",
    "https://example.org/a.mp4?token={}",
    "https://example.org/a.mp4?x=1&X-Amz-Signature={}&y=2",
    "https://example.org/a.mp4?api_key={};b=2",
    "https://example.org/a.mp4?Policy={}",
    "https://example.org/a.mp4#access_token={}",
    "https://example.org/a.mp4?pass%77ord={}",
    "s3://key:{}@bucket/a.mp4",
]


@pytest.mark.parametrize("carrier", CARRIERS)
def test_secrets_are_hidden_and_the_rest_stays(carrier: str) -> None:
    url = carrier.format(SECRET)
    for text in (url, f"could not open {url}: gone", f"<{url}> and {url}"):
        assert SECRET not in redact(text) and "***" in redact(text)
    assert "a.mp4" in redact(url) and redact(redact(url)) == redact(url)


@pytest.mark.parametrize(
    "url",
    ["https://www.youtube.com/watch?v=dQw4w9WgXcQ", "https://example.org/a.mp4?quality=high&start=3",
     "/home/me@work/a.mp4", "abfs://container@account/a.mp4", "not an address at all: me@example.org"],
)  # fmt: skip
def test_what_is_no_secret_is_shown(url: str) -> None:
    assert redact(url) == url


@given(st.text(st.characters(categories=("L", "N"), include_characters="-._~%!$+"), min_size=1, max_size=60))
def test_no_password_survives_whatever_it_is_made_of(word: str) -> None:
    out = redact(f"https://user:{word}@example.org/path?token={word}&n=1")
    assert out == "https://***@example.org/path?token=***&n=1"


def test_values_that_look_drawn_at_random_are_hidden_whatever_their_name() -> None:
    assert (
        redact("https://example.org/a.mp4?e=eyJhbGciOiJIUzI1NiIsInR5cCI6IkpXVCJ9") == "https://example.org/a.mp4?e=***"
    )


def test_shown_text_is_one_printable_short_line() -> None:
    text = shown("a\x1b[31m\nb\u202e" + "x" * 500)
    assert text.isprintable() and len(text) < 160 and "\\x1b" in text


@pytest.mark.parametrize("carrier", CARRIERS)
def test_a_list_line_with_a_secret_is_refused_without_repeating_it(carrier: str, tmp_path: Path) -> None:
    (tmp_path / "list.txt").write_text(carrier.format(SECRET))
    videos = read_list(tmp_path / "list.txt", SourcePolicy())
    assert not videos.entries and SECRET not in videos.model_dump_json()
    assert "NETRC" in videos.problems[0].reason


@pytest.mark.parametrize("status", [200, 404, 503])
def test_an_accepted_secret_is_used_and_still_not_shown(
    server: Served, clip: bytes, policy: SourcePolicy, cache: Path, caplog: pytest.LogCaptureFixture, status: int
) -> None:
    server.answers["/a.mp4"] = lambda handler: handler.reply(status, clip)
    url = server.url(f"/a.mp4?token={SECRET}")
    with caplog.at_level(logging.DEBUG):
        try:
            said = repr(fetch_source(url, policy.model_copy(update={"secrets_in_urls": True}), cache))
        except (ValueError, OSError) as error:
            said = f"{error} {error!r}"
    assert SECRET in server.requests[0].path
    assert SECRET not in said and "token=***" in said
    ours = "".join(record.getMessage() for record in caplog.records if record.name.startswith(("tasks", "flows")))
    assert SECRET not in ours
    kept = b"".join(path.read_bytes() for path in cache.rglob("*.json")) + str(list(cache.rglob("*"))).encode()
    assert SECRET.encode() not in kept


def test_names_of_runs_and_folders_hold_no_secret() -> None:
    for carrier in CARRIERS:
        assert SECRET not in source_name(carrier.format(SECRET))


def test_a_refused_request_does_not_repeat_the_secret(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    request = VideoRequest(video=f"https://me:{SECRET}@example.org/a.mp4", out=str(tmp_path))
    with pytest.raises(ValueError, match="credentials") as caught:
        request.source()
    assert SECRET not in str(caught.value)
