"""What a line of a list, or an argument, names: checked against the policy without touching the network."""

from __future__ import annotations

import ipaddress
import re
import unicodedata
from dataclasses import dataclass
from pathlib import Path
from typing import Literal
from urllib.parse import parse_qs, unquote, urlsplit

import httpx

from storage_schema.secrets import has_secret, shown
from tasks.errors import BadInputError, RefusedSourceError, UnusableSourceError
from tasks.sources.address import address_of_literal, refusal
from tasks.sources.policy import YOUTUBE_HOSTS, SourcePolicy

Kind = Literal["local", "web", "page", "object"]

_SCHEME = re.compile(r"([A-Za-z][A-Za-z0-9+.\-]*)://")
_BARE_YOUTUBE = re.compile(r"(?:www\.|m\.|music\.)?(?:youtube\.com|youtu\.be)/", re.IGNORECASE)
_YOUTUBE_ID = re.compile(r"[A-Za-z0-9_-]{11}")
_ID_FOLDERS = ("shorts", "embed", "live", "v")
_MAX_NAME = 40
# Marks that reverse the direction of text and so can hide what a name really is.
_DIRECTION_MARKS = frozenset("\u200e\u200f\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069")


@dataclass(frozen=True)
class Uri:
    """A checked source.

    Attributes:
        kind: `local` file, `web` address of a file, `page` for yt-dlp, `object` for fsspec.
        text: normalised: an absolute path, or an address in its usual spelling; the same video gives the same text.
    """

    kind: Kind
    text: str

    @property
    def name(self) -> str:
        """A short name of letters, digits, `.`, `_` and `-`, for folders, run names and tables; holds no secrets."""
        return source_name(self.text)


def source_name(text: str) -> str:
    """The short name of a source, checked or not: a YouTube id, or the file's name without its ending."""
    if _SCHEME.match(text) is None:
        return safe_name(Path(text).stem)
    try:
        parts = urlsplit(text)
        return youtube_id(text) or safe_name(Path(unquote(parts.path)).stem or parts.hostname or "")
    except ValueError:
        return safe_name("")


def safe_name(text: str) -> str:
    """Reduce any text (a title, a path) to a harmless file name: no separators, no markup, no leading dot or dash."""
    ascii_text = unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode("ascii")
    return re.sub(r"[^A-Za-z0-9._-]+", "-", ascii_text).strip("-._")[:_MAX_NAME].strip("-._") or "video"


def parse_source(text: str, policy: SourcePolicy, folder: Path | None = None) -> Uri:
    """Check what a person or a list names; makes no connection.

    Args:
        text: a path, or an address.
        policy: what is allowed.
        folder: what relative paths are relative to. With it (a list's own folder) they may not climb out of it with
            `..`; without it they are an argument of the user's and relative to the working folder.

    Raises:
        BadInputError: one of its subclasses, saying what is wrong and what to do.
    """
    _check_text(text, policy)
    if _BARE_YOUTUBE.match(text):
        text = "https://" + text
    scheme = _SCHEME.match(text)
    if scheme is None:
        return _local(Path(text), policy, folder)
    name = scheme.group(1).lower()
    if name in ("http", "https"):
        return _web(text, policy)
    if name == "file":
        return _file_url(text, policy)
    if name in policy.object_protocols:
        return _object(text, name, policy)
    raise RefusedSourceError(
        f"expected a path, or an address with http, https, file or one of {', '.join(policy.object_protocols)}, "
        f"got {shown(text)!r}: download it first, or allow the protocol in AHOY_SOURCES__OBJECT_PROTOCOLS"
    )


def youtube_id(url: str) -> str | None:
    """The id of a video on YouTube; None for anything else."""
    parts = urlsplit(url)
    host = (parts.hostname or "").rstrip(".")
    if not _on(host, YOUTUBE_HOSTS):
        return None
    path = [piece for piece in parts.path.split("/") if piece]
    if _on(host, ("youtu.be",)):
        found = path[0] if path else ""
    elif path and path[0] in _ID_FOLDERS:
        found = path[1] if len(path) > 1 else ""
    else:
        found = parse_qs(parts.query).get("v", [""])[0]
    return found if _YOUTUBE_ID.fullmatch(found) else None


def _on(host: str, domains: tuple[str, ...]) -> bool:
    return any(host == domain or host.endswith("." + domain) for domain in domains)


def _check_text(text: str, policy: SourcePolicy) -> None:
    if not text:
        raise BadInputError("expected a path or an address, got nothing: fill it in or remove it")
    if len(text) > policy.max_url_length:
        raise RefusedSourceError(
            f"expected at most {policy.max_url_length} characters, got {len(text)} in {shown(text)!r}: shorten it"
        )
    bad = next((c for c in text if unicodedata.category(c) in ("Cc", "Cs") or c in _DIRECTION_MARKS), None)
    if bad is not None:
        raise RefusedSourceError(
            f"expected printable text, got {shown(text)!r} with the character U+{ord(bad):04X}: remove it"
        )
    if text.startswith("-"):
        raise RefusedSourceError(
            f"expected a path or an address, got {shown(text)!r}, which looks like an option: "
            f"a file of that name is written ./{shown(text)}"
        )
    if "::" in text and "://" in text and not text.lower().startswith(("http://", "https://")):  # there IPv6 has them
        raise RefusedSourceError(
            f"expected one protocol, got the chain {shown(text)!r}: give the address of the file itself"
        )
    if has_secret(text) and not policy.secrets_in_urls:
        raise RefusedSourceError(
            f"expected an address without credentials, got {shown(text)!r}: it would be stored with the batch. "
            "Put user and password in a netrc file (AHOY_SOURCES__NETRC), use s3:// with this machine's "
            "credentials, or accept that with AHOY_SOURCES__SECRETS_IN_URLS=true"
        )


def _local(path: Path, policy: SourcePolicy, folder: Path | None) -> Uri:
    if not policy.local:
        raise RefusedSourceError(
            f"expected an address, got the path {shown(str(path))!r}: local files are not allowed here "
            "(AHOY_SOURCES__LOCAL=true allows them)"
        )
    if folder is not None and not path.is_absolute() and ".." in path.parts:
        raise RefusedSourceError(
            f"expected a path below the list's own folder, got {shown(str(path))!r}: give the absolute path instead"
        )
    absolute = (folder or Path.cwd()).absolute() / path
    if policy.local_root is not None and not absolute.resolve().is_relative_to(policy.local_root.resolve()):
        raise RefusedSourceError(
            f"expected a file below {policy.local_root}, got {shown(str(path))!r}, which lies elsewhere: "
            "move it there or change AHOY_SOURCES__LOCAL_ROOT"
        )
    return Uri("local", str(absolute))


def _file_url(text: str, policy: SourcePolicy) -> Uri:
    parts = urlsplit(text)
    if parts.netloc not in ("", "localhost") or not parts.path.startswith("/"):
        raise RefusedSourceError(
            f"expected file:///absolute/path, got {shown(text)!r}, which names another machine: write the path"
        )
    path = unquote(parts.path)
    _check_text(path, policy)
    return _local(Path(path), policy, None)


def _object(text: str, protocol: str, policy: SourcePolicy) -> Uri:
    path = text.split("://", 1)[1]
    if not path.strip("/") or ".." in path.split("/"):
        raise RefusedSourceError(
            f"expected {protocol}://BUCKET/KEY, got {shown(text)!r}: give the full address of one file"
        )
    return Uri("object", f"{protocol}://{path}")


def _web(text: str, policy: SourcePolicy) -> Uri:
    url = check_web(text, policy)
    if not policy.is_page_host(url.host):
        return Uri("web", str(url.copy_with(fragment=None)))
    canonical = str(url.copy_with(fragment=None))
    video = youtube_id(canonical)
    if video is not None:
        return Uri("page", f"https://www.youtube.com/watch?v={video}")
    if _on(url.host, YOUTUBE_HOSTS):
        raise UnusableSourceError(
            f"expected one video, got {shown(text)!r}, which is a channel, a playlist or no video: "
            "list its videos with `yt-dlp --flat-playlist --print url ADDRESS` and submit those"
        )
    return Uri("page", canonical)


def check_web(text: str, policy: SourcePolicy) -> httpx.URL:
    """Check an http(s) address, of a list or of a redirect, as far as that goes without a look-up of its host.

    The parsed address is also what the connection is made from, so two parsers cannot disagree about the host.

    Raises:
        RefusedSourceError: malformed, of another scheme, or leading to a literal address inside this network.
    """
    if "\\" in text or any(c.isspace() for c in text):
        raise RefusedSourceError(
            f"expected an address without spaces and backslashes, got {shown(text)!r}: encode them"
        )
    try:
        url = httpx.URL(text)
        host = url.raw_host.decode("ascii")
    except (httpx.InvalidURL, UnicodeError, ValueError) as error:
        raise RefusedSourceError(f"expected an http(s) address, got {shown(text)!r} ({error}): correct it") from None
    if url.scheme not in ("http", "https") or not host.strip("[]. ") or not 0 < (url.port or 443) < 65536:
        raise RefusedSourceError(f"expected an http(s) address with a host, got {shown(text)!r}: correct it")
    name = host.rstrip(".")
    literal = address_of_literal(name)
    if literal is None and _on(name.lower(), ("localhost",)):
        literal = ipaddress.ip_address("127.0.0.1")
    why = refusal(literal) if literal is not None else None
    if why and not policy.may_be_private(host):
        raise RefusedSourceError(
            f"expected a public address, got {shown(text)!r}, which is {why}: "
            "allow the host in AHOY_SOURCES__PRIVATE_HOSTS if that is meant"
        )
    return url
