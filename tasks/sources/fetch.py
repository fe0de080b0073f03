"""One way in for every video: check what it names, bring it to this machine, know it by its content."""

from __future__ import annotations

import logging
import stat
from collections.abc import Callable
from pathlib import Path

from storage_schema.keys import file_sha256
from storage_schema.secrets import shown
from tasks.errors import MissingSourceError, TransientError, UnusableSourceError, is_transient
from tasks.sources.cache import CacheEntry, Notes, cache_entry, prune
from tasks.sources.copying import Limits, with_retries
from tasks.sources.objects import copy_object
from tasks.sources.pages import fetch_page
from tasks.sources.policy import SourcePolicy
from tasks.sources.uri import Uri, parse_source
from tasks.sources.web import download
from tasks.stage import Source

_log = logging.getLogger(__name__)

Fetch = Callable[[str, Limits, CacheEntry], Notes]

_FETCHERS: dict[str, Fetch] = {"web": download, "page": fetch_page, "object": copy_object}


def fetch_source(uri: str, policy: SourcePolicy, cache: Path) -> Source:
    """Bring a video to this machine.

    Args:
        uri: a path, or an http(s), YouTube or fsspec address.
        policy: what is allowed; checked here again, wherever the request came from.
        cache: folder for what is downloaded. What is there and unchanged is not fetched again.

    Returns:
        The file, its hash, a short harmless name, and where it came from without credentials.

    Raises:
        BadInputError: what is named is refused, is not there, or is no single video.
        TransientError: the last of `policy.attempts` tries failed for a reason that may pass.
    """
    checked = parse_source(uri, policy)
    path = _local_file(checked) if checked.kind == "local" else _fetched(checked, policy, cache)
    return Source(path, file_sha256(path), checked.name, shown(checked.text))


def _fetched(uri: Uri, policy: SourcePolicy, cache: Path) -> Path:
    fetch, limits = _FETCHERS[uri.kind], Limits(policy, repr(shown(uri.text)))
    with cache_entry(cache, uri.text) as entry:
        try:
            with_retries(lambda: fetch(uri.text, limits, entry), policy)
        except Exception as error:
            if not is_transient(error):
                raise
            if entry.whole() is None:
                raise TransientError(f"{error} ({policy.attempts} tries)") from error
            _log.warning("%s cannot be asked now (%s): using the copy on this machine", limits.what, shown(str(error)))
        path = entry.video
    prune(cache, policy.cache_bytes)
    return path


def _local_file(uri: Uri) -> Path:
    path = Path(uri.text)
    try:
        mode = path.stat().st_mode
    except OSError as error:
        raise MissingSourceError(
            f"expected a video file, got {shown(uri.text)!r}, which is not there; check the path"
        ) from error
    if not stat.S_ISREG(mode):
        raise UnusableSourceError(
            f"expected a video file, got {shown(uri.text)!r}, which is a folder, a pipe or a device: "
            "give the files one by one"
        )
    return path
