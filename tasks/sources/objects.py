"""Videos in object stores, through fsspec and this machine's own credentials."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from fsspec.core import url_to_fs

from tasks.errors import MissingExtraError, MissingSourceError, UnusableSourceError
from tasks.sources.cache import CacheEntry, Notes
from tasks.sources.copying import Limits, append, finished

BLOCK = 2**20


def copy_object(uri: str, limits: Limits, entry: CacheEntry) -> Notes:
    """Bring an object here in one try, going on where an earlier one stopped if it is still the same object.

    Raises:
        BadInputError: not there, not ours to read, too large, or no video.
        Exception: whatever the file system raises; `is_transient` judges it.
    """
    try:
        fs, path = url_to_fs(uri)
    except ImportError as error:
        raise MissingExtraError(
            f"expected a package for {limits.what}, got none ({error}): install it beside ahoy; "
            "for s3:// that is `pip install s3fs`"
        ) from error
    size, validator = _facts(fs, path, limits)
    whole = entry.whole()
    if whole and whole.validator == validator:
        return whole
    begun = entry.begun()
    if begun is None or begun.validator != validator or entry.partial.stat().st_size > size:
        entry.begin(Notes(validator))
    have = entry.partial.stat().st_size
    with fs.open(path, "rb") as remote:
        remote.seek(have)
        append(entry, _blocks(remote), limits)
    return finished(entry, validator, limits)


def _facts(fs: Any, path: str, limits: Limits) -> tuple[int, str]:
    """Size, and what is equal while the object is."""
    fs.invalidate_cache()
    try:
        info = fs.info(path)
        if info.get("type") == "directory":
            raise UnusableSourceError(f"expected a file, got the folder {limits.what}: list the files in it")
        validator = str(fs.ukey(path))
    except FileNotFoundError as error:
        raise MissingSourceError(f"expected {limits.what}, got nothing there: check bucket and key") from error
    except PermissionError as error:
        raise MissingSourceError(
            f"expected {limits.what}, got no permission: check this machine's credentials for it"
        ) from error
    size = int(info.get("size") or 0)
    limits.check_size(size)
    return size, validator


def _blocks(remote: Any) -> Iterator[bytes]:
    while block := remote.read(BLOCK):
        yield block
