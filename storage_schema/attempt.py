"""One try at making an artifact: a scratch folder, and the commit that publishes it."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from storage_schema.check import check
from storage_schema.errors import StoreError, StoreFullError, free_bytes, is_full
from storage_schema.keys import canonical
from storage_schema.manifest import SCHEMA_VERSION, BlobRef, Manifest, content_hash
from storage_schema.secrets import redact_json

if TYPE_CHECKING:
    from storage_schema.store import ArtifactStore

_LOG = logging.getLogger(__name__)


class Attempt:
    """A local folder `dir` for the stage to write into, until `commit` or `abandon`.

    As a context manager it abandons whatever was not committed, and a full disk inside the block becomes
    `StoreFullError`.

    Attributes:
        key: the key it is for.
        stage: the stage's name.
        name: unique to this attempt.
        dir: the folder, empty at first.
    """

    def __init__(self, store: ArtifactStore, key: str, stage: str, name: str, folder: Path) -> None:
        self.key = key
        self.stage = stage
        self.name = name
        self.dir = folder
        self._store = store
        self._open = True

    def commit(
        self,
        *,
        stage_version: int,
        config: Mapping[str, Any],
        inputs: Mapping[str, str],
        roles: Mapping[str, Mapping[str, Any]] | None = None,
        summary: Mapping[str, Any] | None = None,
    ) -> Manifest:
        """Check the folder, bring its files into the store, and publish them by writing the manifest, last.

        Args:
            stage_version: the stage's version.
            config: the validated configuration.
            inputs: input name -> content hash of the input artifact.
            roles: role -> who filled it (name, licence, sha256 of the weights).
            summary: results as JSON types; secrets that they hold are taken out.

        Returns:
            The manifest under the key: ours, or that of a worker who was faster (our files are then deleted).

        Raises:
            ArtifactError: the folder does not hold what the stage declares; it is left as it is.
            TypeError: something that is not JSON (also ValueError: NaN, infinity); the folder is left as it is.
            StoreFullError: no room; nothing was published and the attempt is over.
            StoreError: the attempt was committed or abandoned before.
        """
        if not self._open:
            raise StoreError(f"attempt {self.name} at {self.stage} is over; start a new one with store.attempt")
        parts = {"config": config, "inputs": inputs, "roles": roles or {}, "summary": redact_json(summary or {})}
        plain = {name: canonical(value, name) for name, value in parts.items()}
        names = check(self.stage, self.dir, self._store.artifacts)
        self._open = False
        try:
            manifest = self._bring_in(names, stage_version, plain)
        except BaseException:
            self._discard(published=True)
            raise
        try:
            winner = self._store.publish(manifest)
        except BaseException as error:
            # The manifest may be visible already (an interrupt, a broken connection): then its blobs have to stay.
            self._discard(published=isinstance(error, StoreFullError))
            raise
        self._discard(published=winner.attempt != self.name)
        return winner

    def abandon(self) -> None:
        """Delete the folder; nothing happens if the attempt is over."""
        if self._open:
            self._open = False
            self._discard(published=False)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        full = None
        if self._open and isinstance(error, Exception) and not isinstance(error, StoreFullError) and is_full(error):
            # Before the folder goes: what it holds plus what is free was not enough.
            written = sum(path.stat().st_size for path in self.dir.rglob("*") if path.is_file())
            free = free_bytes(self.dir)
            full = StoreFullError(self.dir, written + (free or 0) + 1, free)
        self.abandon()
        if full is not None:
            raise full from error

    def _bring_in(self, names: tuple[str, ...], stage_version: int, plain: dict[str, Any]) -> Manifest:
        blobs = tuple(self._put(name) for name in names)
        return Manifest(
            schema_version=SCHEMA_VERSION,
            key=self.key,
            stage=self.stage,
            stage_version=stage_version,
            attempt=self.name,
            created_at=datetime.now(UTC).isoformat(timespec="milliseconds"),
            blobs=blobs,
            content_hash=content_hash(blobs),
            **plain,
        )

    def _put(self, name: str) -> BlobRef:
        backend = self._store.backend
        path = f"{self._store.attempt_folder(self.stage, self.key, self.name)}/{name}"
        size = (self.dir / name).stat().st_size
        digest = backend.put(self.dir / name, path)
        if backend.size(path) != size:
            raise StoreError(f"{path} has {backend.size(path)} bytes in the store, {size} were written; run again")
        return BlobRef(name, path, size, digest)

    def _discard(self, *, published: bool) -> None:
        """Delete what the attempt left. A failure costs space, never correctness: `ArtifactStore.gc` finds it later."""
        shutil.rmtree(self.dir, ignore_errors=True)
        if published:
            try:
                self._store.backend.remove(self._store.attempt_folder(self.stage, self.key, self.name))
            except OSError as error:
                _LOG.warning("attempt %s at %s could not be deleted: %s", self.name, self.stage, error)
