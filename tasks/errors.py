"""What may be tried again and what may not: the one place that the retry table of the queue asks.

`BadInputError` says that the same request will fail the same way (the video is gone, the policy forbids it, the file
is no video). `TransientError` says that a later try may succeed (a connection broke, a server was busy). Everything
else is judged by `is_transient`.
"""

from __future__ import annotations

import errno
import socket
import traceback
from collections.abc import Iterator

from pydantic import ValidationError

from ahoy_core.formats.errors import VideoError
from storage_schema.errors import StoreFullError


class BadInputError(ValueError):
    """The request itself is at fault: trying again cannot help. The text says what to change."""


class ListError(BadInputError):
    """A list of videos as a whole cannot be read; what is wrong with single lines is a `ListProblem` instead."""


class RefusedSourceError(BadInputError):
    """The policy forbids this source: its scheme, its address, its size, or something in its text."""


class MissingSourceError(BadInputError, FileNotFoundError):
    """There is nothing at the path or address, or it wants credentials that we do not have."""


class UnusableSourceError(BadInputError):
    """There is something, but it is no single video: a page, a playlist, an archive, a live stream."""


class MissingExtraError(BadInputError):
    """An optional package is not installed; the text names the extra."""


class TransientError(OSError):
    """A later try may succeed.

    Attributes:
        retry_after_s: how long the other side asked us to wait, None if it did not say.
    """

    def __init__(self, message: str, retry_after_s: float | None = None) -> None:
        super().__init__(message)
        self.retry_after_s = retry_after_s


_TRANSIENT_ERRNOS = frozenset(
    {
        errno.EAGAIN,
        errno.EBUSY,
        errno.ECONNABORTED,
        errno.ECONNREFUSED,
        errno.ECONNRESET,
        errno.EHOSTUNREACH,
        errno.EINTR,
        errno.EIO,
        errno.ENETDOWN,
        errno.ENETRESET,
        errno.ENETUNREACH,
        errno.EPIPE,
        errno.ESTALE,
        errno.ETIMEDOUT,
    }
)
_MAX_MESSAGE = 2000  # characters
_TRANSIENT_LOOKUPS = frozenset({socket.EAI_AGAIN, socket.EAI_FAIL})

# Classes of optional packages, by name, so that judging an error imports none of them.
_TRANSIENT_NAMES = frozenset(
    {
        "aiohttp.ClientConnectionError",
        "aiohttp.ClientPayloadError",
        "aiohttp.ServerDisconnectedError",
        "asyncpg.PostgresConnectionError",
        "botocore.ConnectTimeoutError",
        "botocore.ConnectionClosedError",
        "botocore.EndpointConnectionError",
        "botocore.ReadTimeoutError",
        "fsspec.FSTimeoutError",
        "httpcore.NetworkError",
        "httpcore.RemoteProtocolError",
        "httpcore.TimeoutException",
        "httpx.NetworkError",
        "httpx.RemoteProtocolError",
        "httpx.TimeoutException",
    }
)


def is_bad_input(error: BaseException) -> bool:
    """Whether the request or the video is at fault, so that a rerun without a change is pointless."""
    return isinstance(error, (BadInputError, VideoError, ValidationError))


def is_transient(error: BaseException | None) -> bool:
    """Whether trying the same again later may succeed.

    Judges the error itself and, where that one says nothing either way, what caused it. Bad input never is transient,
    whatever caused it; a full disk is not, because it stays full until somebody frees space.
    """
    for link in _chain(error):
        if is_bad_input(link) or isinstance(link, StoreFullError):
            return False
        if _says_transient(link):
            return True
    return False


def message_of(error: BaseException) -> str:
    """The error's class and text in one short piece, for tables and logs."""
    return "".join(traceback.format_exception_only(error)).strip()[:_MAX_MESSAGE]


def _says_transient(error: BaseException) -> bool:
    if isinstance(error, (TransientError, TimeoutError, ConnectionError)):
        return True
    if isinstance(error, socket.gaierror):
        return error.errno in _TRANSIENT_LOOKUPS
    if isinstance(error, OSError) and error.errno in _TRANSIENT_ERRNOS:
        return True
    return any(f"{kind.__module__.split('.')[0]}.{kind.__name__}" in _TRANSIENT_NAMES for kind in type(error).__mro__)


def _chain(error: BaseException | None) -> Iterator[BaseException]:
    """The error, then what it was raised from."""
    seen: set[int] = set()
    while error is not None and id(error) not in seen:
        seen.add(id(error))
        yield error
        error = error.__cause__
