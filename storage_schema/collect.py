"""Finds and deletes what no manifest, index or running worker needs any more.

Ages are told by the store's own clock, so that a worker whose clock is wrong collects nothing too early.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from storage_schema.backend import SCRATCH, newest, store_time
from storage_schema.errors import CorruptError
from storage_schema.partition import Partition
from storage_schema.schemas import TABLES

if TYPE_CHECKING:
    from storage_schema.store import ArtifactStore

DAMAGED = "damaged"  # where `storage_schema.survey.repair` puts what it takes out of the way


@dataclass(frozen=True)
class Orphan:
    """Something that can go: its path, relative to the root of the store, what it is, its files and bytes."""

    path: str
    kind: str
    files: int
    bytes: int


def collect(store: ArtifactStore, older_than_s: float, *, dry_run: bool = False) -> list[Orphan]:
    """Delete what killed attempts, repaired artifacts, lost merges and dead workers left.

    Args:
        store: the store.
        older_than_s: only what was last written longer ago than this; more than the longest stage takes. Deleting a
            live attempt would cost its work, never a wrong result: what it commits does not verify.
        dry_run: delete nothing.

    Returns:
        What was, or would be, deleted, sorted by path.

    Raises:
        StoreVersionError: a newer version of this software wrote something; what was deleted before is gone.
    """
    limit = store_time(store.backend) - older_than_s
    found = []
    for path, kind in orphans(store):
        files = store.backend.files(path) or [path]
        if newest(store.backend, [path, *files] if path.startswith(SCRATCH) else files) <= limit:
            found.append(Orphan(path, kind, len(files), _bytes(store, files)))
            if not dry_run:
                store.backend.remove(path)
    return sorted(found, key=lambda orphan: orphan.path)


def orphans(store: ArtifactStore) -> Iterator[tuple[str, str]]:
    """Path and kind of everything that nothing needs, whatever its age; attempts that are being made are among it.

    Raises:
        StoreVersionError: a newer version of this software wrote something.
    """
    backend = store.backend
    for stage in backend.names("artifacts"):
        for key in backend.names(f"artifacts/{stage}"):
            for path in _attempts(store, stage, key):
                yield path, "attempt"
    for name in backend.names(SCRATCH):
        yield f"{SCRATCH}/{name}", "scratch"
    for table, schema in TABLES.items():
        for folder in backend.names(f"tables/{table}"):
            for path in Partition(backend, schema, folder.removeprefix("batch=")).orphans():
                yield path, "merged file"
    for key in backend.names("leases"):
        if all(_expired(store, path) for path in backend.files(f"leases/{key}")):
            yield f"leases/{key}", "lease"
    for path in backend.files(DAMAGED):
        yield path, "damaged file"


def _attempts(store: ArtifactStore, stage: str, key: str) -> list[str]:
    attempts = store.backend.names(f"artifacts/{stage}/{key}/attempts")
    if not attempts:
        return []
    # Read after the attempts were listed, so that one that commits meanwhile is seen.
    needed = set()
    for generation in reversed(store.generations(stage, key)):
        try:
            needed.add(store.read_manifest(stage, key, generation).attempt)
        except (CorruptError, FileNotFoundError):
            continue
        # Older generations were found damaged when this one was written.
        break
    return [store.attempt_folder(stage, key, attempt) for attempt in attempts if attempt not in needed]


def _expired(store: ArtifactStore, path: str) -> bool:
    try:
        return float(json.loads(store.backend.read(path))["expires_at"]) <= store_time(store.backend)
    except FileNotFoundError:
        return False
    except (ValueError, TypeError, KeyError):
        return True


def _bytes(store: ArtifactStore, files: list[str]) -> int:
    total = 0
    for file in files:
        try:
            total += store.backend.size(file)
        except (FileNotFoundError, IsADirectoryError):
            continue
    return total
