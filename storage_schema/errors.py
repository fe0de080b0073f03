"""What can go wrong in the store, as types that callers can tell apart."""

from __future__ import annotations

import errno
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from storage_schema.secrets import redact

# EFBIG is what a process or file-system limit on file size gives: for the user it is the same problem.
_FULL_ERRNOS = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
# Writers in other languages (safetensors, torch, FFmpeg) report a full disk in words only.
# The last two are an object store's: its disks are full, or the bucket has all that it may hold.
_FULL_WORDS = (
    "no space left on device",
    "disk quota exceeded",
    "file too large",
    "minimum free drive threshold",
    "bucket quota exceeded",
)


class StoreError(Exception):
    """The store cannot do what was asked; the message says what to do."""


class StoreVersionError(StoreError):
    """Something in the store was written by a newer version of this software."""


class CorruptError(StoreError):
    """Bytes in the store are not those that were committed."""


class UnknownBatchError(StoreError):
    """The store has no batch of that name."""


class BatchExistsError(StoreError):
    """A batch of that name is there already, made from another list; the message says what differs."""


class ArtifactError(ValueError):
    """A folder does not hold what its stage declares, or a name is not allowed in the store."""


class StoreFullError(OSError):
    """The file system under the store has no room left; nothing was published.

    Attributes:
        filename: the path that could not be written.
        needed: bytes that must be free for it to succeed (a lower bound where the writer did not say how much it had
            left).
        free: bytes that were free, None where that is unknown.
    """

    def __init__(self, path: str | Path, needed: int, free: int | None) -> None:
        room = "" if free is None else f", {free} are free"
        message = f"no room left for {path}: at least {needed} bytes needed{room}; free some space and run again"
        super().__init__(errno.ENOSPC, message, str(path))
        self.needed = needed
        self.free = free

    def __str__(self) -> str:
        return str(self.strerror)


class StoreUnavailableError(OSError):
    """The store did not answer, or not with what was asked for: trying again later may help."""

    def __init__(self, where: str, error: BaseException) -> None:
        super().__init__(errno.EHOSTUNREACH, f"{where}: {redact(str(error)) or type(error).__name__}; try again later")

    def __str__(self) -> str:
        return str(self.strerror)


def is_full(error: BaseException | None) -> bool:
    """True if `error`, or what caused it, says that a file system is full or a file-size limit was met."""
    seen: set[int] = set()
    while error is not None and id(error) not in seen:
        seen.add(id(error))
        if isinstance(error, OSError) and error.errno in _FULL_ERRNOS:
            return True
        if any(words in str(error).lower() for words in _FULL_WORDS):
            return True
        error = error.__cause__ or error.__context__
    return False


def free_bytes(path: str | Path) -> int | None:
    """Bytes free under the nearest existing folder of `path`; None if it cannot be told, as of a URL."""
    if "://" in str(path):
        return None
    folder = Path(path)
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    try:
        return shutil.disk_usage(folder).free
    except OSError:
        return None


@contextmanager
def room_for(path: str | Path, needed: int) -> Iterator[None]:
    """Turn a full disk inside the block into `StoreFullError` naming `path` and the bytes `needed`."""
    try:
        yield
    except StoreFullError:
        raise
    except Exception as error:
        if not is_full(error):
            raise
        raise StoreFullError(path, needed, free_bytes(path)) from error
