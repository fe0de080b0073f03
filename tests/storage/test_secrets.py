"""Secrets are hidden wherever they stand, and nothing else is touched."""

from __future__ import annotations

import io
import logging

import pytest
from hypothesis import given
from hypothesis import strategies as st

from storage_schema.secrets import HIDDEN, RedactSecrets, redact, redact_json, redact_url

SECRET = "s3cr3tValue9"


@pytest.mark.parametrize(
    "url",
    [
        f"https://user:{SECRET}@host/a.mp4",
        f"https://{SECRET}@host:8080/a.mp4",
        f"https://b.s3.amazonaws.com/a.mp4?X-Amz-Algorithm=A&X-Amz-Credential={SECRET}&X-Amz-Signature={SECRET}",
        f"https://host/a.mp4?Expires=1&Signature={SECRET}&Key-Pair-Id={SECRET}&Policy={SECRET}",
        f"https://account.blob.core.windows.net/c/a.mp4?sv=2024&sig={SECRET}",
        f"https://host/a.mp4?access_token={SECRET}#token={SECRET}",
        f"s3://{SECRET}:{SECRET}@bucket/a.mp4",
        f"https://host/a?apiKey={SECRET}&v=1",
    ],
)
def test_what_opens_doors_is_taken_out_of_urls_and_out_of_text_about_them(url: str) -> None:
    for hidden in (redact_url(url), redact(f"GET {url} failed: 403"), str(redact_json({"a": [url]}))):
        assert SECRET not in hidden and HIDDEN in hidden
    assert redact_url(redact_url(url)) == redact_url(url)


@pytest.mark.parametrize(
    "text",
    [
        "https://www.youtube.com/watch?v=dQw4w9WgXcQ&t=10s",
        "s3://bucket/folder/clip 1.mp4",
        "/home/me/clips/a@b.mp4",
        "https://host/a.mp4?size=large&subject=1#t=3",
        "expected a tensor [T,3,H,W], got [3]; key 12 of the policy",
        "C:\\clips\\a.mp4",
        "https://[broken",
        "",
    ],
)
def test_what_holds_no_secret_stays_as_it_is(text: str) -> None:
    assert redact_url(text) == text and redact(text) == text


def test_an_address_that_is_stored_can_be_opened_again_while_messages_hide_what_only_looks_secret() -> None:
    url = "https://host/video?id=3f2b8c1d9e7a4f6b8c0d2e1f"
    assert redact_url(url) == url and redact_json({"a": url}) == {"a": url}
    assert redact(f"cannot open {url}") == "cannot open https://host/video?id=***"


@pytest.mark.parametrize(
    "text",
    [
        f"Authorization: Bearer {SECRET}",
        f"password={SECRET} refused",
        f"AWS_SECRET_ACCESS_KEY='{SECRET}'",
        f'{{"api_key": "{SECRET}"}}',
        "AKIAABCDEFGHIJKLMNOP is not authorised",
    ],
)
def test_secrets_in_prose_are_hidden(text: str) -> None:
    assert SECRET not in redact(text) and "AKIAABC" not in redact(text)
    assert redact(redact(text)) == redact(text)


@given(st.text())
def test_redacting_twice_is_redacting_once(text: str) -> None:
    assert redact(redact(text)) == redact(text)
    assert redact_url(redact_url(text)) == redact_url(text)


def test_values_of_keys_that_name_secrets_are_replaced_at_any_depth() -> None:
    value = {"headers": [{"Authorization": SECRET}], "cookies": {"a": SECRET}, "steps": 3, "token": "[v]", "key": None}
    hidden = redact_json(value)
    assert SECRET not in str(hidden)
    assert hidden["steps"] == 3 and hidden["token"] == "[v]" and hidden["key"] is None


def test_a_logger_with_the_filter_writes_no_secret() -> None:
    stream = io.StringIO()
    handler = logging.StreamHandler(stream)
    handler.addFilter(RedactSecrets())
    logger = logging.getLogger("test.secrets")
    logger.addHandler(handler)
    try:
        logger.warning("cannot open %s (%d)", f"https://me:{SECRET}@host/a", 403)
        logger.warning("100%% fine: %s", "plain")
    finally:
        logger.removeHandler(handler)
    assert SECRET not in stream.getvalue()
    assert "host/a (403)" in stream.getvalue() and "100% fine: plain" in stream.getvalue()
