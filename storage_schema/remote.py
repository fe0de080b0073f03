"""The backend for fsspec file systems that are not this machine's disk: object stores, and memory for tests."""

from __future__ import annotations

import hashlib
import logging
import threading
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from fsspec import AbstractFileSystem
from fsspec.implementations.memory import MemoryFileSystem

from storage_schema.errors import StoreError, StoreFullError, StoreUnavailableError, is_full, room_for
from storage_schema.keys import file_sha256

_LOG = logging.getLogger(__name__)
_CHUNK = 1 << 20
# memory:// tests for a file and then writes it. One lock for the process makes the two one step; no other process sees
# that memory.
_CREATE = threading.Lock()
# Object stores have no folders to make; asking for one costs a request, or makes a bucket of a misspelt name.
_FLAT = frozenset({"s3", "s3a", "gs", "gcs", "abfs", "az"})
# What a server that works can answer.
_ANSWERS = (
    FileNotFoundError,
    FileExistsError,
    IsADirectoryError,
    NotADirectoryError,
    PermissionError,
    StoreFullError,
    StoreUnavailableError,
)
# Their errors are no OSError, though they mean one.
_CLIENTS = frozenset({"botocore", "aiobotocore", "aiohttp", "gcsfs", "adlfs", "azure", "google", "requests"})


class RemoteBackend:
    """A folder of any fsspec file system. A whole-object write is taken to be one step, as it is on object stores."""

    def __init__(self, fs: AbstractFileSystem, root: str, workers: int) -> None:
        self.fs = fs
        self.root = root.rstrip("/")
        self.url = str(fs.unstrip_protocol(self.root))
        protocols = {fs.protocol} if isinstance(fs.protocol, str) else set(fs.protocol)
        self._flat = bool(protocols & _FLAT)
        self._conditional: bool | None = None
        if workers > 1:
            self._refuse_several_workers(workers)

    def create(self, path: str, data: bytes) -> bool:
        """See `Backend`. Where the file system cannot do it in one step, it is tested first: enough for one worker."""
        with _CREATE:
            if not self._can_create() and self._exists(path):
                return False
            return self._create(path, data)

    def write(self, path: str, data: bytes) -> None:
        """See `Backend`."""
        with self._sending(path, len(data)):
            self.fs.pipe_file(self._full(path), data)

    def put(self, source: Path, path: str) -> str:
        """Upload a file, read it back, and return the hash of what arrived.

        Raises:
            StoreError: what was read back is not what was sent.
        """
        with self._sending(path, source.stat().st_size):
            self.fs.put_file(str(source), self._full(path))
        if (arrived := self.sha256(path)) != file_sha256(source):
            self.remove(path)
            raise StoreError(f"upload of {source.name} to {self.url}/{path} arrived damaged; run again")
        return arrived

    def read(self, path: str) -> bytes:
        """See `Backend`."""
        with self._asking(path):
            return bytes(self.fs.cat_file(self._full(path)))

    def size(self, path: str) -> int:
        """See `Backend`."""
        return int(self._info(path)["size"])

    def sha256(self, path: str) -> str:
        """See `Backend`."""
        digest = hashlib.sha256()
        with self._asking(path), self.fs.open(self._full(path), "rb") as file:
            while piece := file.read(_CHUNK):
                digest.update(piece)
        return digest.hexdigest()

    def modified(self, path: str) -> float:
        """See `Backend`; now, where the file system does not say, so that nothing is taken for old."""
        try:
            with self._asking(path):
                return float(self.fs.modified(self._full(path)).timestamp())
        except NotImplementedError:
            return time.time()

    def names(self, path: str) -> list[str]:
        """See `Backend`."""
        self.fs.invalidate_cache()
        try:
            with self._asking(path):
                entries = self.fs.ls(self._full(path), detail=False)
        except (FileNotFoundError, NotADirectoryError):
            return []
        return sorted({str(entry).rstrip("/").rsplit("/", 1)[-1] for entry in entries})

    def files(self, path: str) -> list[str]:
        """See `Backend`."""
        self.fs.invalidate_cache()
        prefix = self.root + "/"
        try:
            with self._asking(path):
                return sorted(str(file).removeprefix(prefix) for file in self.fs.find(self._full(path)))
        except FileNotFoundError:
            return []

    def remove(self, path: str) -> None:
        """See `Backend`."""
        try:
            with self._asking(path):
                self.fs.rm(self._full(path), recursive=True)
        except FileNotFoundError:
            return

    def local(self, path: str) -> Path | None:
        """See `Backend`."""
        return None

    def download(self, path: str, target: Path) -> None:
        """See `Backend`."""
        with room_for(target, self.size(path)), self._asking(path):
            self.fs.get_file(self._full(path), str(target))

    def new_folder(self, name: str, fallback: Path) -> Path:
        """See `Backend`."""
        folder = fallback / name
        with room_for(folder, 0):
            folder.mkdir(parents=True)
        return folder

    def _full(self, path: str) -> str:
        return f"{self.root}/{path}"

    def _info(self, path: str) -> dict[str, Any]:
        self.fs.invalidate_cache()
        with self._asking(path):
            return dict(self.fs.info(self._full(path)))

    def _exists(self, path: str) -> bool:
        try:
            self._info(path)
        except FileNotFoundError:
            return False
        return True

    @contextmanager
    def _asking(self, path: str) -> Iterator[None]:
        """One kind of error for every way in which a network, a client library or a server can fail."""
        try:
            yield
        except _ANSWERS:
            raise
        except Exception as error:
            foreign = type(error).__module__.partition(".")[0] in _CLIENTS
            if is_full(error) or not (foreign or isinstance(error, OSError)):
                raise
            raise StoreUnavailableError(f"{self.url}/{path}", error) from error

    @contextmanager
    def _sending(self, path: str, size: int) -> Iterator[None]:
        """Make the folder, where there are folders, and say what a failure means for who sends `size` bytes."""
        try:
            with room_for(f"{self.url}/{path}", size), self._asking(path):
                if not self._flat:
                    self.fs.makedirs(self._full(path).rsplit("/", 1)[0], exist_ok=True)
                yield
        except FileNotFoundError as error:
            raise StoreError(
                f"{self.url}: expected a bucket that is there ({error}); create it, or check --store"
            ) from error

    def _create(self, path: str, data: bytes) -> bool:
        conditional = self._can_create()
        try:
            with self._sending(path, len(data)):
                if conditional:
                    self.fs.pipe_file(self._full(path), data, mode="create")
                else:
                    self.fs.pipe_file(self._full(path), data)
        except FileExistsError:
            return False
        return True

    def _can_create(self) -> bool:
        """Whether the file system keeps the promise of mode="create"; tried, because many accept and ignore it."""
        if self._conditional is None:
            probe = f"scratch/probe-{uuid.uuid4().hex}"
            try:
                with self._sending(probe, 1):
                    self.fs.pipe_file(self._full(probe), b"1", mode="create")
                    self.fs.pipe_file(self._full(probe), b"2", mode="create")
                self._conditional = False
            except FileExistsError:
                self._conditional = True
            except (TypeError, ValueError, NotImplementedError):
                self._conditional = False
            finally:
                self.remove(probe)
            if not self._conditional:
                _LOG.warning("%s cannot create a file only if it is absent: use it with one worker at a time", self.url)
        return self._conditional

    def _refuse_several_workers(self, workers: int) -> None:
        if type(self.fs) is MemoryFileSystem:
            raise StoreError(
                f"{self.url} lives in one process, {workers} workers were declared; use a folder or an object store"
            )
        if not self._can_create():
            raise StoreError(
                f"{self.url} cannot create a file only if it is absent, so {workers} workers could both commit; "
                "use one worker, or a store that can (a folder, S3)"
            )
