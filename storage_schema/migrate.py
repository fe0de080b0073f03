"""Brings what older versions wrote to the current schemas, in place.

Everything is readable without it: old files are upgraded each time they are read. Each step is one of the store's own
safe operations (a merge, a manifest of the next number, a whole-file write), so that runs may go on meanwhile and an
interrupted migration is simply started again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from storage_schema.batches import BATCH_VERSION, batch_path, list_batches, read_batch
from storage_schema.errors import CorruptError
from storage_schema.manifest import SCHEMA_VERSION, Manifest
from storage_schema.schemas import TABLES
from storage_schema.sealed import sealed_version
from storage_schema.store import ArtifactStore, manifest_path
from storage_schema.tables import Tables


def migrate(
    store: ArtifactStore, *, dry_run: bool = False, progress: Callable[[str], None] | None = None
) -> dict[str, int]:
    """Upgrade every table, batch and artifact manifest that an older version wrote.

    Args:
        store: the store.
        dry_run: only count.
        progress: called with what is looked at next.

    Returns:
        What was, or would be, upgraded: partitions of tables, batches, artifacts. Damaged things are left alone
        (`storage_schema.survey` finds them).

    Raises:
        StoreVersionError: a newer version wrote something; what was upgraded before stays so.
    """
    tell = progress or (lambda what: None)
    return {
        "tables": _migrate_tables(store, dry_run, tell),
        "batches": _migrate_batches(store, dry_run),
        "artifacts": _migrate_artifacts(store, dry_run, tell),
    }


def _migrate_tables(store: ArtifactStore, dry_run: bool, tell: Callable[[str], None]) -> int:
    tables, count = Tables(store), 0
    for table in TABLES:
        for batch in tables.batches(table):
            tell(f"{table} of {batch}")
            try:
                count += tables.is_outdated(table, batch) if dry_run else tables.upgrade(table, batch) > 0
            except CorruptError:
                continue
    return count


def _migrate_batches(store: ArtifactStore, dry_run: bool) -> int:
    count = 0
    for batch in list_batches(store):
        path = batch_path(batch)
        try:
            old = sealed_version(store.backend.read(path), "batch")
        except (CorruptError, FileNotFoundError):
            continue
        if old < BATCH_VERSION:
            count += 1
            if not dry_run:
                store.backend.write(path, read_batch(store, batch).to_json())
    return count


def _migrate_artifacts(store: ArtifactStore, dry_run: bool, tell: Callable[[str], None]) -> int:
    count = 0
    for stage in store.backend.names("artifacts"):
        tell(f"artifacts of {stage}")
        for key in store.backend.names(f"artifacts/{stage}"):
            count += _migrate_artifact(store, stage, key, dry_run)
    return count


def _migrate_artifact(store: ArtifactStore, stage: str, key: str, dry_run: bool) -> bool:
    """Write the newest whole manifest again under the next number; whether that was needed."""
    generations = store.generations(stage, key)
    for generation in reversed(generations):
        found = store.inspect(stage, key, generation, verify=False)
        if isinstance(found, Manifest):
            if sealed_version(store.backend.read(manifest_path(stage, key, generation)), "manifest") == SCHEMA_VERSION:
                return False
            if not dry_run:
                upgraded = replace(found, schema_version=SCHEMA_VERSION)
                store.backend.create(manifest_path(stage, key, generations[-1] + 1), upgraded.to_json())
            return True
    return False
