"""The artifact store: the authority on what is done.

Layout, all of it readable by a person:

    artifacts/<stage>/<key>/manifest.0001.json         written last, by one create-if-absent; 0002 repairs 0001
    artifacts/<stage>/<key>/attempts/<attempt>/<file>  blobs, under a path unique to the attempt
    leases/<key>/0001.json                             who is at work on a key
    tables/<table>/batch=<batch>/<file>.parquet        see storage_schema.tables
    batches/<batch>/manifest.json                      see storage_schema.batches
    scratch/                                           attempts in progress, where the store is on this machine
"""

from __future__ import annotations

import errno
import logging
import shutil
import tempfile
import uuid
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path

from platformdirs import user_cache_path

from storage_schema.artifacts import ARTIFACTS, Blob
from storage_schema.attempt import Attempt
from storage_schema.backend import SCRATCH, Backend, open_backend
from storage_schema.collect import collect
from storage_schema.errors import ArtifactError, CorruptError
from storage_schema.keys import check_stage, file_sha256
from storage_schema.lease import Lease
from storage_schema.manifest import BlobRef, Manifest, check_name, generation_of, manifest_name

_LOG = logging.getLogger(__name__)


class ArtifactStore:
    """Artifacts by key under an fsspec URL.

    Args:
        url: where; a plain path means this machine's disk.
        cache_dir: where downloads and scratch folders go if the store is not on this machine; the user's cache by
            default.
        workers: how many will write at the same time. More than one is refused where nothing stops two from committing
            the same key.
        artifacts: what each stage declares.

    Raises:
        StoreError: several workers on a store that cannot have them, or a path that is a file.
    """

    def __init__(
        self,
        url: str | Path,
        *,
        cache_dir: Path | None = None,
        workers: int = 1,
        artifacts: Mapping[str, Sequence[Blob]] = ARTIFACTS,
    ) -> None:
        self.backend: Backend = open_backend(url, workers)
        self.url = self.backend.url
        self.artifacts = artifacts
        self.cache_dir = Path(cache_dir) if cache_dir is not None else user_cache_path("ahoy") / "store"

    def lookup(self, key: str, *, stage: str | None = None, verify: bool = True) -> Manifest | None:
        """The result stored under a key, if it is there and whole.

        Args:
            key: from `stage_key`.
            stage: the stage's name, if known: saves looking through all of them.
            verify: compare the hash of every output; otherwise only that each is there and has its size.

        Returns:
            The newest manifest whose outputs are whole; None if there is none (the log says why), so the stage has to
            run.

        Raises:
            StoreVersionError: a newer version of this software wrote it.
        """
        check_name(key, "key")
        for name in [stage] if stage is not None else self.backend.names("artifacts"):
            if (manifest := self._newest_whole(name, key, self.generations(name, key), verify)) is not None:
                return manifest
        return None

    def attempt(self, key: str, stage: str) -> Attempt:
        """Start an attempt at a key: a scratch folder, and `commit`.

        Raises:
            ArtifactError: the stage declares no files, or the key is not a name.
            StoreFullError: no room for even a folder.
        """
        check_name(key, "key")
        check_stage(stage)
        if stage not in self.artifacts:
            raise ArtifactError(f"stage {stage!r} declares no files; add it to ARTIFACTS")
        name = f"{datetime.now(UTC):%Y%m%dT%H%M%SZ}-{uuid.uuid4().hex[:12]}"
        return Attempt(self, key, stage, name, self.backend.new_folder(name, self.cache_dir / SCRATCH))

    def fetch(self, manifest: Manifest, name: str | None = None) -> Path:
        """A blob as a local file, or the artifact as a local folder; read only: it is the store itself or its cache.

        Args:
            manifest: of the artifact.
            name: of the blob; None for the folder with all of them.

        Returns:
            The path in the store if it is on this machine, otherwise that of a copy whose hash was compared.

        Raises:
            KeyError: the artifact has no such blob.
            FileNotFoundError: the blob is gone from the store (look it up again: the stage has to run).
            CorruptError: the store gave other bytes than were committed.
            StoreFullError: no room for the copy.
        """
        folder = self.attempt_folder(manifest.stage, manifest.key, manifest.attempt)
        blobs = manifest.blobs if name is None else (manifest.blob(name),)
        local = self.backend.local(folder)
        if local is None:
            local = self.cache_dir / folder
            for blob in blobs:
                self._download(blob, local / blob.name)
        for blob in blobs:
            if not (local / blob.name).is_file():
                raise FileNotFoundError(
                    errno.ENOENT, f"{manifest.stage} lost its output; look the key up again", str(local / blob.name)
                )
        return local if name is None else local / name

    def lease(self, key: str, owner: str, ttl_s: float, *, wait_s: float = 0.0) -> Lease:
        """Say that `owner` is at work on `key`, so that others need not be.

        Args:
            key: from `stage_key`.
            owner: who, for the logs.
            ttl_s: seconds after which others may take it over if its holder died; it is renewed while its `with` block
                runs.
            wait_s: how long to wait for another holder; 0 returns at once.

        Returns:
            A context manager whose value is true if the lease is held: `with store.lease(...) as held: ...`. Work
            without it is wasteful at worst, never wrong.
        """
        check_name(key, "key")
        return Lease(self.backend, key, owner, ttl_s, wait_s)

    def gc(self, older_than_s: float, *, dry_run: bool = False) -> list[str]:
        """Delete what killed attempts, repairs and merges left (`storage_schema.collect`).

        Args:
            older_than_s: only what was last written longer ago than this; more than the longest stage takes.
            dry_run: only say what would be deleted.

        Returns:
            Paths that were deleted, relative to the root of the store, sorted.
        """
        return [orphan.path for orphan in collect(self, older_than_s, dry_run=dry_run)]

    def publish(self, manifest: Manifest) -> Manifest:
        """Write a manifest under its key unless a whole one is there; what `Attempt.commit` ends with.

        Returns:
            The manifest that counts: this one, or the one that was there.
        """
        stage, key, data = manifest.stage, manifest.key, manifest.to_json()
        while True:
            # One listing for both questions: a number seen only by the second could be that of a whole manifest.
            generations = self.generations(stage, key)
            if (winner := self._newest_whole(stage, key, generations, verify=True)) is not None:
                _LOG.info("%s %s was committed by attempt %s first", stage, key[:12], winner.attempt)
                return winner
            # All of them are damaged, so ours is next. If somebody takes it meanwhile, look again.
            if self.backend.create(manifest_path(stage, key, max(generations, default=0) + 1), data):
                return manifest

    def attempt_folder(self, stage: str, key: str, attempt: str) -> str:
        """Where an attempt's blobs lie, relative to the root of the store."""
        return f"{_folder(stage, key)}/attempts/{attempt}"

    def generations(self, stage: str, key: str) -> list[int]:
        """Numbers of the manifests under a key, ascending; the newest whole one counts."""
        numbers = (generation_of(name) for name in self.backend.names(_folder(stage, key)))
        return sorted(number for number in numbers if number is not None)

    def read_manifest(self, stage: str, key: str, generation: int) -> Manifest:
        """One manifest, unverified.

        Raises:
            CorruptError: not a whole manifest of this key.
            StoreVersionError: a newer version of this software wrote it.
            FileNotFoundError: there is none of that number.
        """
        manifest = Manifest.from_json(self.backend.read(manifest_path(stage, key, generation)))
        if (manifest.stage, manifest.key) != (stage, key):
            raise CorruptError(f"manifest is of {manifest.stage} {manifest.key}")
        return manifest

    def _newest_whole(self, stage: str, key: str, generations: list[int], verify: bool) -> Manifest | None:
        found = (self._whole(stage, key, generation, verify) for generation in reversed(generations))
        return next((manifest for manifest in found if manifest is not None), None)

    def _whole(self, stage: str, key: str, generation: int, verify: bool) -> Manifest | None:
        found = self.inspect(stage, key, generation, verify=verify)
        if isinstance(found, Manifest):
            return found
        _LOG.warning("%s %s (manifest %d) does not count: %s", stage, key[:12], generation, found)
        return None

    def inspect(self, stage: str, key: str, generation: int, *, verify: bool = True) -> Manifest | str:
        """A manifest whose outputs are whole, or the reason why it does not count.

        Raises:
            StoreVersionError: a newer version of this software wrote it.
        """
        try:
            manifest = self.read_manifest(stage, key, generation)
            for blob in manifest.blobs:
                self._verify(blob, verify)
        except (CorruptError, FileNotFoundError, IsADirectoryError) as error:
            return f"{error.filename} is missing" if isinstance(error, OSError) and error.filename else str(error)
        except OSError as error:
            if error.errno != errno.EIO:
                raise
            return f"{error.filename} cannot be read"
        return manifest

    def _verify(self, blob: BlobRef, content: bool) -> None:
        if (size := self.backend.size(blob.path)) != blob.size:
            raise CorruptError(f"{blob.path} has {size} bytes, {blob.size} were committed")
        if content and self.backend.sha256(blob.path) != blob.sha256:
            raise CorruptError(f"{blob.path} has other bytes than were committed")

    def _download(self, blob: BlobRef, target: Path) -> None:
        if target.is_file() and target.stat().st_size == blob.size and file_sha256(target) == blob.sha256:
            return
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=target.parent, prefix=".download-") as folder:
            part = Path(folder) / "part"
            self.backend.download(blob.path, part)
            if file_sha256(part) != blob.sha256:
                raise CorruptError(f"{self.url}/{blob.path} has other bytes than were committed; look the key up again")
            shutil.move(part, target)


def _folder(stage: str, key: str) -> str:
    return f"artifacts/{stage}/{key}"


def manifest_path(stage: str, key: str, generation: int) -> str:
    """Where a manifest lies, relative to the root of the store."""
    return f"{_folder(stage, key)}/{manifest_name(generation)}"
