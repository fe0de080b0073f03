"""Fetched videos on this machine's disk: one folder an address, one process at a time in it."""

from __future__ import annotations

import hashlib
import json
import logging
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

from filelock import FileLock, Timeout

_log = logging.getLogger(__name__)

# A file handed out this recently may still be read by the stage that asked for it.
IN_USE_S = 6 * 3600.0
_LOCK = ".lock"


@dataclass(frozen=True)
class Notes:
    """What is known of a file beside its bytes.

    Attributes:
        validator: ETag, modification time or the like: equal while the remote file is the same; empty if there is none.
        size: bytes.
        sha256: of the whole file; empty while it is being fetched.
    """

    validator: str = ""
    size: int = -1
    sha256: str = ""


@dataclass(frozen=True)
class CacheEntry:
    """The folder of one address, held by this process."""

    folder: Path

    @property
    def video(self) -> Path:
        """The whole file, once it is here."""
        return self.folder / "video"

    @property
    def partial(self) -> Path:
        """What has been fetched so far."""
        return self.folder / "partial"

    def whole(self) -> Notes | None:
        """Notes of the whole file, None if it is not here or not as long as it was."""
        notes = self._read("video.json")
        return notes if notes and self.video.is_file() and self.video.stat().st_size == notes.size else None

    def begun(self) -> Notes | None:
        """Notes of the partial file, None if there is none that could be gone on with."""
        notes = self._read("partial.json")
        return notes if notes and notes.validator and self.partial.is_file() and self.partial.stat().st_size else None

    def begin(self, notes: Notes) -> None:
        """Forget what was fetched so far and note what is about to be."""
        self.partial.write_bytes(b"")
        self._write("partial.json", notes)

    def drop_partial(self) -> None:
        """Forget what was fetched so far."""
        self.partial.unlink(missing_ok=True)
        (self.folder / "partial.json").unlink(missing_ok=True)

    def finish(self, validator: str) -> Notes:
        """Make the partial file the whole one."""
        with self.partial.open("rb") as file:
            sha256 = hashlib.file_digest(file, "sha256").hexdigest()
        notes = Notes(validator, self.partial.stat().st_size, sha256)
        # In this order: a kill in between leaves a file without notes, which is fetched again, never a wrong pair.
        (self.folder / "video.json").unlink(missing_ok=True)
        self.partial.replace(self.video)
        self._write("video.json", notes)
        (self.folder / "partial.json").unlink(missing_ok=True)
        return notes

    def _read(self, name: str) -> Notes | None:
        try:
            return Notes(**json.loads((self.folder / name).read_text(encoding="utf-8")))
        except (OSError, ValueError, TypeError):
            return None

    def _write(self, name: str, notes: Notes) -> None:
        beside = self.folder / f".{name}"
        beside.write_text(json.dumps(asdict(notes)), encoding="utf-8")
        beside.replace(self.folder / name)


@contextmanager
def cache_entry(cache: Path, uri: str) -> Iterator[CacheEntry]:
    """Hold the folder of an address; another process that wants the same video waits and then finds it there."""
    folder = cache / hashlib.sha256(uri.encode()).hexdigest()
    folder.mkdir(parents=True, exist_ok=True)
    with FileLock(cache / (folder.name + _LOCK)):
        folder.mkdir(exist_ok=True)  # `prune` may have been quicker
        yield CacheEntry(folder)
        folder.touch()


def prune(cache: Path, keep_bytes: int, in_use_s: float = IN_USE_S) -> int:
    """Delete the longest unused videos until no more than `keep_bytes` are left.

    Args:
        cache: the folder.
        keep_bytes: of all files together.
        in_use_s: what was handed out more recently stays in any case.

    Returns:
        Bytes deleted.
    """
    folders = sorted((f for f in cache.iterdir() if f.is_dir()), key=lambda f: f.stat().st_mtime)
    sizes = {folder: sum(file.stat().st_size for file in folder.iterdir()) for folder in folders}
    excess, deleted = sum(sizes.values()) - keep_bytes, 0
    for folder in folders:
        if deleted >= excess or time.time() - folder.stat().st_mtime < in_use_s:
            break
        try:
            with FileLock(cache / (folder.name + _LOCK), timeout=0):
                shutil.rmtree(folder)
        except Timeout:
            continue
        deleted += sizes[folder]
        _log.info("deleted %s from the cache of sources: %d bytes", folder.name, sizes[folder])
    return deleted
