"""What the store needs of a file system, and the one for this machine's disks.

Paths are relative to the root of the store, with `/`. `storage_schema.remote` holds the backend for every other fsspec
file system.
"""

from __future__ import annotations

import errno
import os
import shutil
import time
import uuid
from pathlib import Path
from typing import Protocol

from fsspec.core import url_to_fs
from fsspec.implementations.local import LocalFileSystem

from storage_schema.errors import StoreError, room_for
from storage_schema.keys import file_sha256
from storage_schema.secrets import redact_url

# What link(2) answers on file systems without hard links (FAT, some network and virtual machine mounts).
_NO_LINKS = frozenset({errno.EPERM, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS, errno.EMLINK})
SCRATCH = "scratch"


class Backend(Protocol):
    """A file system under a root."""

    url: str

    def create(self, path: str, data: bytes) -> bool:
        """Write a whole file if there is none, as one step; False if there is one already."""

    def write(self, path: str, data: bytes) -> None:
        """Write a whole file as one step, over what may be there."""

    def put(self, source: Path, path: str) -> str:
        """Bring a local file into the store and return `sha256(path)`; `source` may be gone afterwards."""

    def read(self, path: str) -> bytes:
        """All bytes of a file; FileNotFoundError if there is none."""

    def size(self, path: str) -> int:
        """Bytes of a file; FileNotFoundError if there is none."""

    def sha256(self, path: str) -> str:
        """Hash of the bytes that are stored now; FileNotFoundError if there is none."""

    def modified(self, path: str) -> float:
        """When a file was last written, seconds since the epoch."""

    def names(self, path: str) -> list[str]:
        """Names in a folder, sorted; empty if there is no such folder."""

    def files(self, path: str) -> list[str]:
        """Paths of all files below a folder, sorted; empty if there is no such folder."""

    def remove(self, path: str) -> None:
        """Delete a file or a folder with all it holds; nothing happens if there is none."""

    def local(self, path: str) -> Path | None:
        """Where the file lies on this machine, None if it has to be downloaded."""

    def download(self, path: str, target: Path) -> None:
        """Copy a file of the store to `target`."""

    def new_folder(self, name: str, fallback: Path) -> Path:
        """A new local folder from which `put` is cheap; under `fallback` if the store is not on this machine."""


def open_backend(url: str | Path, workers: int = 1) -> Backend:
    """The backend for a URL.

    Args:
        url: any fsspec URL; a plain path means this machine's disk.
        workers: how many processes or machines will write at the same time.

    Raises:
        StoreError: several workers on a file system that cannot create a file only if it is absent, a file's path, or a
            package for this kind of store is missing.
        ValueError: no file system is known for the URL.
    """
    from storage_schema.remote import RemoteBackend

    try:
        fs, root = url_to_fs(str(url), use_listings_cache=False)
    except ImportError as error:
        extra = str(url).split("://", 1)[0]
        raise StoreError(f"{redact_url(str(url))}: {error}; pip install 'ahoy-avatars[{extra}]'") from error
    if isinstance(fs, LocalFileSystem):
        return LocalBackend(Path(root))
    return RemoteBackend(fs, root, workers)


class LocalBackend:
    """A folder on a disk of this machine, or one mounted like it.

    Every write is durable before it becomes visible: data are flushed to the disk first, then the name appears, then
    the folder is flushed. A power cut at any point leaves the old state or the new one.
    """

    def __init__(self, root: Path) -> None:
        self.root = root.absolute()
        if self.root.exists() and not self.root.is_dir():
            raise StoreError(f"{self.root} is a file, expected a folder or nothing; give the store a folder of its own")
        self.url = self.root.as_uri()

    def create(self, path: str, data: bytes) -> bool:
        """See `Backend`."""
        target = self.root / path
        with room_for(target, len(data)):
            make_folders(target.parent)
            temporary = self._temporary(data)
            try:
                os.link(temporary, target)
            except FileExistsError:
                return False
            except OSError as error:
                if error.errno not in _NO_LINKS:
                    raise
                # A power cut in here can leave a torn file under the final name. Manifests carry a checksum for that.
                if not _create_in_place(target, data):
                    return False
            finally:
                temporary.unlink()
            flush_folder(target.parent)
        return True

    def write(self, path: str, data: bytes) -> None:
        """See `Backend`."""
        target = self.root / path
        with room_for(target, len(data)):
            make_folders(target.parent)
            temporary = self._temporary(data)
            try:
                temporary.replace(target)
            except OSError:
                temporary.unlink()
                raise
            flush_folder(target.parent)

    def put(self, source: Path, path: str) -> str:
        """Move a file of this machine into the store (it has to lie on the same disk: see `new_folder`)."""
        target = self.root / path
        with room_for(target, source.stat().st_size):
            make_folders(target.parent)
            with source.open("rb") as file:
                os.fsync(file.fileno())
            source.replace(target)
            flush_folder(target.parent)
        return self.sha256(path)

    def read(self, path: str) -> bytes:
        """See `Backend`."""
        return (self.root / path).read_bytes()

    def size(self, path: str) -> int:
        """See `Backend`."""
        return (self.root / path).stat().st_size

    def sha256(self, path: str) -> str:
        """See `Backend`."""
        return file_sha256(self.root / path)

    def modified(self, path: str) -> float:
        """See `Backend`."""
        return (self.root / path).stat().st_mtime

    def names(self, path: str) -> list[str]:
        """See `Backend`."""
        try:
            return sorted(entry.name for entry in (self.root / path).iterdir())
        except (FileNotFoundError, NotADirectoryError):
            return []

    def files(self, path: str) -> list[str]:
        """See `Backend`."""
        found = (Path(folder) / name for folder, _, names in os.walk(self.root / path) for name in names)
        return sorted(file.relative_to(self.root).as_posix() for file in found)

    def remove(self, path: str) -> None:
        """See `Backend`."""
        target = self.root / path
        try:
            if target.is_dir() and not target.is_symlink():
                shutil.rmtree(target)
            else:
                target.unlink()
        except FileNotFoundError:
            return

    def local(self, path: str) -> Path | None:
        """See `Backend`."""
        return self.root / path

    def download(self, path: str, target: Path) -> None:
        """See `Backend`."""
        with room_for(target, self.size(path)):
            shutil.copyfile(self.root / path, target)

    def new_folder(self, name: str, fallback: Path) -> Path:
        """See `Backend`."""
        folder = self.root / SCRATCH / name
        with room_for(folder, 0):
            make_folders(folder.parent)
            folder.mkdir()
        return folder

    def _temporary(self, data: bytes) -> Path:
        folder = self.root / SCRATCH
        make_folders(folder)
        temporary = folder / f"{uuid.uuid4().hex}.tmp"
        try:
            with temporary.open("xb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
        return temporary


def make_folders(folder: Path) -> None:
    """Create a folder and its parents so that they survive a power cut."""
    missing = []
    while not folder.is_dir():
        missing.append(folder)
        folder = folder.parent
    for new in reversed(missing):
        new.mkdir(exist_ok=True)
        flush_folder(new.parent)


def flush_folder(folder: Path) -> None:
    """Make the names in a folder survive a power cut."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def store_time(backend: Backend) -> float:
    """What the store's own clock says, seconds since the epoch: ages are told by it, not by that of whoever asks."""
    probe = f"{SCRATCH}/clock-{uuid.uuid4().hex}"
    backend.write(probe, b"1")
    try:
        return backend.modified(probe)
    finally:
        backend.remove(probe)


def newest(backend: Backend, paths: list[str]) -> float:
    """Latest time at which one of `paths` was written, seconds since the epoch; now if they are gone."""
    times = []
    for path in paths:
        try:
            times.append(backend.modified(path))
        except FileNotFoundError:
            times.append(time.time())
    return max(times, default=time.time())


def _create_in_place(target: Path, data: bytes) -> bool:
    try:
        with target.open("xb") as file:
            try:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            except BaseException:
                target.unlink()
                raise
    except FileExistsError:
        return False
    return True
