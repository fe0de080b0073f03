"""Writing a download to disk block by block, within its limits, and trying again what may pass."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import TypeVar

from tenacity import RetryCallState, Retrying, retry_if_exception, stop_after_attempt, wait_exponential_jitter

from ahoy_core.formats.sniff import HEAD_BYTES, not_a_video
from tasks.errors import RefusedSourceError, TransientError, UnusableSourceError, is_transient
from tasks.sources.cache import CacheEntry, Notes
from tasks.sources.policy import SourcePolicy

T = TypeVar("T")

MAX_WAIT_S = 60.0


@dataclass(frozen=True)
class Limits:
    """What one download may take; the clock starts when this is made."""

    policy: SourcePolicy
    what: str  # for messages, redacted
    started: float = field(default_factory=time.monotonic)

    def check_size(self, size: int) -> None:
        """Refuse more bytes than allowed.

        Raises:
            RefusedSourceError: too large.
        """
        if size > self.policy.max_bytes:
            raise RefusedSourceError(
                f"expected at most {self.policy.max_bytes} bytes, got {size} or more from {self.what}: "
                "use a smaller video or raise AHOY_SOURCES__MAX_BYTES"
            )

    def check_time(self) -> None:
        """Refuse to go on for ever with a server that sends a byte now and then.

        Raises:
            TransientError: the time is up.
        """
        spent = time.monotonic() - self.started
        if spent > self.policy.total_timeout_s:
            raise TransientError(
                f"expected {self.what} within {self.policy.total_timeout_s:.0f} s, got only a part: try again, or "
                "raise AHOY_SOURCES__TOTAL_TIMEOUT_S"
            )

    def pace(self, done: int, since: float) -> None:
        """Sleep as long as needed to stay below the allowed rate, `done` bytes after `since`."""
        rate = self.policy.max_bytes_per_s
        if rate is not None:
            time.sleep(max(0.0, done / rate - (time.monotonic() - since)))


def append(entry: CacheEntry, blocks: Iterable[bytes], limits: Limits) -> int:
    """Append blocks to the partial file, looking at the beginning of a file before the rest is fetched.

    Returns:
        Bytes in the file now.

    Raises:
        RefusedSourceError: it grows too large; the partial file is deleted.
        UnusableSourceError: its beginning is no video's; likewise.
        TransientError: the time is up; the partial file stays.
    """
    size, since, added = entry.partial.stat().st_size, time.monotonic(), 0
    head = b"" if size == 0 else None
    with entry.partial.open("ab") as file:
        for block in blocks:
            try:
                limits.check_size(size + len(block))
                if head is not None:
                    head += block[: HEAD_BYTES - len(head)]
                    if len(head) >= HEAD_BYTES:
                        check_head(head, limits.what)
                        head = None
            except ValueError:
                entry.drop_partial()
                raise
            file.write(block)
            size, added = size + len(block), added + len(block)
            limits.pace(added, since)
            limits.check_time()
    return size


def check_head(head: bytes, what: str) -> None:
    """Refuse what is no video by its first bytes.

    Raises:
        UnusableSourceError: it is something else.
    """
    other = not_a_video(head)
    if other:
        raise UnusableSourceError(
            f"expected a video, got {what}, which is {other}: give the address of the video itself"
        )


def finished(entry: CacheEntry, validator: str, limits: Limits) -> Notes:
    """Make the partial file the whole one, unless its beginning shows that it is no video.

    Raises:
        UnusableSourceError: it is something else; it is deleted.
    """
    with entry.partial.open("rb") as file:
        head = file.read(HEAD_BYTES)
    try:
        check_head(head, limits.what)
    except UnusableSourceError:
        entry.drop_partial()
        raise
    return entry.finish(validator)


def with_retries(attempt: Callable[[], T], policy: SourcePolicy) -> T:
    """Call until it succeeds, fails for good, or has failed `policy.attempts` times; the last error is raised."""

    def wait(state: RetryCallState) -> float:
        error = state.outcome.exception() if state.outcome else None
        asked = getattr(error, "retry_after_s", None)
        return min(MAX_WAIT_S, float(asked)) if asked is not None else float(backoff(state))

    backoff = wait_exponential_jitter(initial=policy.backoff_s, max=MAX_WAIT_S, jitter=policy.backoff_s)
    retrying = Retrying(
        stop=stop_after_attempt(policy.attempts), wait=wait, retry=retry_if_exception(is_transient), reraise=True
    )
    return retrying(attempt)
