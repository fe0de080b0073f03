"""Videos on pages, YouTube's first: yt-dlp as a library (extra `ahoy[youtube]`), behind the gate."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from storage_schema.secrets import redact
from tasks.errors import (
    BadInputError,
    MissingExtraError,
    MissingSourceError,
    RefusedSourceError,
    TransientError,
    UnusableSourceError,
)
from tasks.sources.cache import CacheEntry, Notes
from tasks.sources.copying import Limits, finished
from tasks.sources.gate import open_gate
from tasks.sources.policy import SourcePolicy
from tasks.sources.web import status_error

# Over plain http(s) or DASH segments alone: HLS may be handed to an FFmpeg program, which connects on its own.
_PROTOCOL = "[protocol~='^(https?|http_dash_segments)$']"
# What yt-dlp says of troubles that pass, where no exception of its own tells them from others.
_BUSY = ("not a bot", "rate-limit", "rate limit", "too many requests", "try again later")
_BROKEN = ("got error", "giving up after", "bytes read")
_COOKIES = "cookies"


def fetch_page(url: str, limits: Limits, entry: CacheEntry) -> Notes:
    """Bring the video of a page here in one try.

    The picture alone is fetched, without sound where that is offered apart. What is here already is kept: a page's
    video does not change, and asking costs as much as a small download.

    Raises:
        BadInputError: refused, gone, private, too large, a playlist, a live stream; or yt-dlp is not installed.
        TransientError: a later try may succeed.
    """
    whole = entry.whole()
    if whole:
        return whole
    try:
        import yt_dlp
    except ImportError as error:
        raise MissingExtraError(
            f"expected yt-dlp for {limits.what}, got none: install the extra, `pip install 'ahoy-avatars[youtube]'`"
        ) from error
    entry.drop_partial()
    with open_gate(limits.policy) as gate:
        try:
            with yt_dlp.YoutubeDL(_options(entry, limits, gate.url)) as downloader:
                info = downloader.extract_info(url, download=False)
                _check_info(info, limits)
                downloader.process_info(info)
        except yt_dlp.utils.YoutubeDLError as error:
            if gate.refusals:
                raise gate.refusals[0] from error
            raise _judged(error, limits) from error
        finally:
            (entry.folder / _COOKIES).unlink(missing_ok=True)
    _take(entry, limits)
    notes = finished(entry, f"{info['extractor_key']} {info['id']}", limits)
    if limits.policy.archive is not None:
        _note(limits.policy.archive, info)
    return notes


def _options(entry: CacheEntry, limits: Limits, proxy: str) -> dict[str, Any]:
    policy = limits.policy

    def watch(status: dict[str, Any]) -> None:
        limits.check_size(int(status.get("downloaded_bytes") or 0))
        limits.check_time()

    return {
        "proxy": proxy,
        "format": _format(policy),
        # A name of our own: titles hold separators, markup and worse.
        "outtmpl": {"default": str(entry.folder / "page.video").replace("%", "%%")},
        "cookiefile": _private_copy(policy.cookies, entry),
        "ratelimit": policy.max_bytes_per_s,
        "sleep_interval_requests": 0.5 if policy.max_bytes_per_s else 0,
        "max_filesize": policy.max_bytes,
        "socket_timeout": policy.read_timeout_s,
        "progress_hooks": [watch],
        "noplaylist": True,
        "extract_flat": "in_playlist",
        "fixup": "never",  # would run a program
        "postprocessors": [],
        "hls_prefer_native": True,
        "cachedir": False,
        "quiet": True,
        "no_warnings": True,
        "noprogress": True,
        "logger": _Silent(),
        "color": "never",
        "continuedl": False,
        "overwrites": True,
        "retries": 2,
        "fragment_retries": 5,
    }


def _format(policy: SourcePolicy) -> str:
    """The largest picture within the wanted height, without sound if possible; whatever there is otherwise."""
    low = f"[height<={policy.max_height}]"
    return "/".join((f"bv*{low}{_PROTOCOL}", f"bv*{_PROTOCOL}", f"b{_PROTOCOL}"))


def _check_info(info: Any, limits: Limits) -> None:
    if not info:
        raise UnusableSourceError(f"expected a video, got nothing on {limits.what}: check the address")
    if info.get("_type", "video") != "video":
        raise UnusableSourceError(
            f"expected one video, got several on {limits.what}: list them with "
            "`yt-dlp --flat-playlist --print url ADDRESS` and submit those"
        )
    if info.get("is_live") or info.get("live_status") in ("is_live", "is_upcoming"):
        raise UnusableSourceError(f"expected a video, got the live stream {limits.what}: wait until it is over")
    limits.check_size(int(info.get("filesize") or info.get("filesize_approx") or 0))


def _take(entry: CacheEntry, limits: Limits) -> None:
    """Move what yt-dlp wrote into the place of a partial download."""
    written = entry.folder / "page.video"
    if not written.is_file():
        raise UnusableSourceError(
            f"expected a file, got none from {limits.what}: it may be larger than {limits.policy.max_bytes} bytes "
            "(AHOY_SOURCES__MAX_BYTES)"
        )
    limits.check_size(written.stat().st_size)
    written.replace(entry.partial)


def _judged(error: Exception, limits: Limits) -> BadInputError | TransientError:
    """Which of our errors one of yt-dlp's is; it wraps the cause in `exc_info`."""
    from yt_dlp.networking.exceptions import HTTPError, TransportError
    from yt_dlp.utils import ContentTooShortError, ExtractorError, UnsupportedError

    text = redact(str(error)).removeprefix("ERROR: ")
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, (BadInputError, TransientError)):
            return cause
        if isinstance(cause, HTTPError):
            return status_error(cause.status, limits.what)
        if isinstance(cause, (TransportError, ContentTooShortError)):
            return TransientError(f"expected {limits.what}, got {text}: try again later")
        if isinstance(cause, UnsupportedError):
            return UnusableSourceError(
                f"expected a page with a video, got {limits.what} without one: check the address"
            )
        info = getattr(cause, "exc_info", None)
        inner = info[1] if info else getattr(cause, "cause", None) or cause.__cause__ or cause.__context__
        if isinstance(cause, ExtractorError) and inner is None:
            break
        cause = inner
    if any(words in text.lower() for words in _BROKEN):
        return TransientError(f"expected all of {limits.what}, got {text}: try again later")
    if any(words in text.lower() for words in _BUSY):
        return TransientError(
            f"expected {limits.what}, got {text}: wait, or give cookies (AHOY_SOURCES__COOKIES)", 60.0
        )
    return MissingSourceError(
        f"expected {limits.what}, got {text}: check it in a browser; update yt-dlp if it plays there"
    )


def _private_copy(cookies: Path | None, entry: CacheEntry) -> str | None:
    """yt-dlp writes the cookies file back at the end: workers beside each other each get one of their own."""
    if cookies is None:
        return None
    try:
        content = cookies.read_bytes()
    except OSError as error:
        raise RefusedSourceError(f"expected a cookies file at {cookies}, got {type(error).__name__}") from None
    copy = entry.folder / _COOKIES
    with os.fdopen(os.open(copy, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "wb") as file:
        file.write(content)
    return str(copy)


def _note(archive: Path, info: Any) -> None:
    """Append to the download archive in yt-dlp's own form; one write, so that workers do not mix their lines."""
    archive.parent.mkdir(parents=True, exist_ok=True)
    line = f"{str(info['extractor_key']).lower()} {info['id']}\n".encode()
    known = archive.read_bytes() if archive.is_file() else b""
    if line.strip() in known.splitlines():
        return
    descriptor = os.open(archive, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    try:
        os.write(descriptor, line)
    finally:
        os.close(descriptor)


class _Silent:
    """yt-dlp's messages hold addresses; what matters comes back as an exception."""

    def debug(self, message: str) -> None: ...

    def info(self, message: str) -> None: ...

    def warning(self, message: str) -> None: ...

    def error(self, message: str) -> None: ...
