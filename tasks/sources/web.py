"""http(s) downloads: resumed, bounded, and to checked addresses only, also after redirects."""

from __future__ import annotations

import netrc
import re
import ssl
from base64 import b64encode
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from typing import Any

import httpcore
import httpx

from storage_schema.secrets import redact, shown
from tasks.errors import (
    BadInputError,
    MissingSourceError,
    RefusedSourceError,
    TransientError,
    UnusableSourceError,
)
from tasks.sources.address import resolve
from tasks.sources.cache import CacheEntry, Notes
from tasks.sources.copying import Limits, append, finished
from tasks.sources.policy import SourcePolicy
from tasks.sources.uri import check_web

USER_AGENT = "ahoy"
_REDIRECTS = frozenset({301, 302, 303, 307, 308})
_TRANSIENT_STATUS = frozenset({408, 425, 429, 500, 502, 503, 504})
_CONTENT_RANGE = re.compile(r"bytes (\d+)-\d+/(\d+|\*)")
_TRANSIENT = (httpcore.NetworkError, httpcore.TimeoutException, httpcore.RemoteProtocolError)


class CheckedBackend(httpcore.SyncBackend):
    """Connects to an address that `resolve` has just checked, never to a name."""

    def __init__(self, policy: SourcePolicy) -> None:
        self._policy = policy

    def connect_tcp(
        self,
        host: str,
        port: int,
        timeout: float | None = None,
        local_address: str | None = None,
        socket_options: Iterable[Any] | None = None,
    ) -> httpcore.NetworkStream:
        """Try the checked addresses in order; TLS still verifies the name."""
        addresses = resolve(host, port, self._policy)
        for address in addresses[:-1]:
            try:
                return super().connect_tcp(address, port, timeout, local_address, socket_options)
            except (httpcore.ConnectError, httpcore.ConnectTimeout):
                continue
        return super().connect_tcp(addresses[-1], port, timeout, local_address, socket_options)

    def connect_unix_socket(
        self, path: str, timeout: float | None = None, socket_options: Iterable[Any] | None = None
    ) -> httpcore.NetworkStream:
        """Refused: no video comes out of a socket of this machine."""
        raise RefusedSourceError(f"expected a host, got the socket {path!r}")


def download(url: str, limits: Limits, entry: CacheEntry) -> Notes:
    """Bring a file here in one try, going on where an earlier one stopped if the server says that it is the same file.

    What is here already is asked about and not fetched again if it is unchanged.

    Raises:
        BadInputError: refused, not there, too large, or no video.
        TransientError: a later try may succeed; what was fetched so far is kept.
    """
    whole, begun = entry.whole(), entry.begun()
    headers = _condition(whole) if whole else _range(begun, entry)
    try:
        with _response(url, headers, limits) as (status, got, blocks):
            if whole and (status == 304 or _unchanged(whole, got)):
                return whole
            return _receive(status, got, blocks, limits, entry)
    except _TRANSIENT as error:
        raise TransientError(
            f"expected all of {limits.what}, got {type(error).__name__} ({redact(str(error))}): try again"
        ) from error
    except (httpcore.ProtocolError, httpcore.UnsupportedProtocol) as error:
        raise UnusableSourceError(
            f"expected HTTP from {limits.what}, got something else ({redact(str(error))}): check the address"
        ) from error


def _receive(status: int, got: Mapping[str, str], blocks: Iterator[bytes], limits: Limits, entry: CacheEntry) -> Notes:
    validator, length = _validator(got), int(got.get("content-length", "-1"))
    if got.get("content-encoding", "identity") not in ("identity", ""):
        raise UnusableSourceError(f"expected the file as it is, got {limits.what} compressed: use another address")
    if status == 416:
        entry.drop_partial()
        raise TransientError(f"expected the rest of {limits.what}, got no such part: starting anew")
    if status == 206:
        begun = entry.begun()
        place = _CONTENT_RANGE.fullmatch(got.get("content-range", ""))
        have = entry.partial.stat().st_size if begun else 0
        if begun is None or place is None or int(place.group(1)) != have or validator != begun.validator:
            entry.drop_partial()
            raise TransientError(f"expected the rest of {limits.what}, got another part or version: starting anew")
        expected = have + length if length >= 0 else -1
    else:
        entry.begin(Notes(validator))
        expected = length
    limits.check_size(expected)
    size = append(entry, blocks, limits)
    if expected >= 0 and size != expected:
        raise TransientError(f"expected {expected} bytes, got {size} from {limits.what}: try again")
    return finished(entry, validator, limits)


def _unchanged(whole: Notes, got: Mapping[str, str]) -> bool:
    """Whether a full answer is the file that is here: by its validator, or, where it has none, by its length."""
    if whole.validator:
        return _validator(got) == whole.validator
    return got.get("content-length") == str(whole.size)


@contextmanager
def _response(
    url: str, headers: Mapping[str, str], limits: Limits
) -> Iterator[tuple[int, Mapping[str, str], Iterator[bytes]]]:
    """Follow redirects, each checked like the first address, and give status, headers and body of the answer."""
    policy = limits.policy
    timeout = {"connect": policy.connect_timeout_s, "read": policy.read_timeout_s, "write": policy.read_timeout_s}
    with httpcore.ConnectionPool(
        ssl_context=ssl.create_default_context(), network_backend=CheckedBackend(policy)
    ) as pool:
        for _ in range(policy.max_redirects + 1):
            limits.check_time()
            target = check_web(url, policy)
            sent = {"User-Agent": USER_AGENT, "Accept-Encoding": "identity", **headers, **_credentials(target, policy)}
            with pool.stream(
                "GET", _raw(target), headers=list(sent.items()), extensions={"timeout": timeout}
            ) as answer:
                got = {k.decode("latin-1").lower(): v.decode("latin-1") for k, v in answer.headers}
                if answer.status in _REDIRECTS and "location" in got:
                    url = _joined(target, got["location"], limits)
                    continue
                _check_status(answer.status, got, limits.what)
                yield answer.status, got, answer.iter_stream()
                return
    raise UnusableSourceError(
        f"expected at most {policy.max_redirects} redirects, got more from {limits.what}: give the final address"
    )


def _joined(target: httpx.URL, location: str, limits: Limits) -> str:
    try:
        joined = target.join(location)
    except (httpx.InvalidURL, ValueError) as error:
        raise UnusableSourceError(
            f"expected an address, got a redirect of {limits.what} to {shown(location)!r} ({error})"
        ) from None
    if target.scheme == "https" and joined.scheme != "https":
        raise RefusedSourceError(
            f"expected https to stay https, got a redirect of {limits.what} to {shown(str(joined))!r}: use that address"
        )
    return str(joined)


def _raw(url: httpx.URL) -> httpcore.URL:
    return httpcore.URL(scheme=url.raw_scheme, host=url.raw_host, port=url.port, target=url.raw_path)


def _check_status(status: int, got: Mapping[str, str], what: str) -> None:
    if status not in (200, 206, 304, 416):
        raise status_error(status, what, got.get("retry-after"))


def status_error(status: int, what: str, retry_after: str | None = None) -> BadInputError | TransientError:
    """The error that an HTTP status stands for."""
    if status in _TRANSIENT_STATUS:
        return TransientError(f"expected {what}, got status {status}: try again later", _seconds(retry_after))
    if status in (401, 403, 407):
        return MissingSourceError(
            f"expected {what}, got status {status}: it wants credentials (AHOY_SOURCES__NETRC, AHOY_SOURCES__COOKIES) "
            "or refuses us"
        )
    if status in (404, 410):
        return MissingSourceError(
            f"expected {what}, got status {status}: it is not there (any more); check the address"
        )
    return UnusableSourceError(f"expected {what}, got status {status}: check the address")


def _seconds(retry_after: str | None) -> float | None:
    """Read `Retry-After`, seconds or a date (RFC 9110, 10.2.3)."""
    if not retry_after:
        return None
    if retry_after.strip().isdigit():
        return float(retry_after)
    try:
        return max(0.0, (parsedate_to_datetime(retry_after) - datetime.now(UTC)).total_seconds())
    except (ValueError, TypeError):
        return None


def _validator(got: Mapping[str, str]) -> str:
    """A strong ETag or a modification time; a weak ETag promises the same meaning, not the same bytes."""
    etag = got.get("etag", "")
    return etag if etag and not etag.startswith("W/") else got.get("last-modified", "")


def _condition(whole: Notes) -> dict[str, str]:
    if not whole.validator:
        return {}
    return {"If-None-Match" if whole.validator.startswith('"') else "If-Modified-Since": whole.validator}


def _range(begun: Notes | None, entry: CacheEntry) -> dict[str, str]:
    if begun is None:
        return {}
    return {"Range": f"bytes={entry.partial.stat().st_size}-", "If-Range": begun.validator}


def _credentials(url: httpx.URL, policy: SourcePolicy) -> dict[str, str]:
    """User and password of the netrc file for exactly this host, over TLS or inside the network only."""
    if policy.netrc is None or not (url.scheme == "https" or policy.may_be_private(url.host)):
        return {}
    try:
        found = netrc.netrc(policy.netrc).hosts.get(url.host)
    except (OSError, netrc.NetrcParseError) as error:
        raise RefusedSourceError(f"expected a netrc file at {policy.netrc}, got {error.__class__.__name__}") from None
    if found is None:
        return {}
    return {"Authorization": "Basic " + b64encode(f"{found[0]}:{found[2]}".encode()).decode()}
