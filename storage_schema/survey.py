"""Looks at everything in a store: what is whole, what is damaged, what is too old or too new, what can go."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import Any, Literal

from storage_schema.batches import list_batches, read_batch
from storage_schema.collect import Orphan, collect
from storage_schema.errors import CorruptError, StoreVersionError, UnknownBatchError
from storage_schema.manifest import SCHEMA_VERSION, Manifest
from storage_schema.partition import Partition, partition_folder
from storage_schema.rows import Part, from_parquet
from storage_schema.schemas import TABLES
from storage_schema.sealed import sealed_version
from storage_schema.store import ArtifactStore, manifest_path

Kind = Literal["artifact", "batch", "index", "table", "newer", "unknown"]


@dataclass(frozen=True)
class Finding:
    """Something that is not as it should be.

    Attributes:
        kind: `newer` and `unknown` are for a newer version of this software, all others can be repaired.
        path: relative to the root of the store; of an artifact, its folder.
        problem: what is wrong.
        remedy: what to do, or what `repair` does.
    """

    kind: Kind
    path: str
    problem: str
    remedy: str


@dataclass(frozen=True)
class Survey:
    """What a store holds.

    Attributes:
        counts: whole artifacts, blobs, bytes (of blobs), batches, table_files, rows, outdated (older schema).
        findings: what is damaged, or unknown here.
        orphans: what nothing needs and is old enough to go.
    """

    counts: dict[str, int]
    findings: tuple[Finding, ...]
    orphans: tuple[Orphan, ...]

    def to_json(self) -> dict[str, Any]:
        """Plain JSON types."""
        return {"schema_version": 1, **asdict(self)}


def survey(
    store: ArtifactStore,
    *,
    verify: bool = True,
    orphans_older_than_s: float = 86_400.0,
    progress: Callable[[str], None] | None = None,
) -> Survey:
    """Look at everything; changes nothing.

    Args:
        store: the store.
        verify: hash every output; otherwise only their sizes are compared.
        orphans_older_than_s: younger ones may be attempts that are being made.
        progress: called with what is looked at next.

    Returns:
        What there is and what is wrong with it. Not a picture of one moment: runs may go on meanwhile.

    Raises:
        StoreUnavailableError: the store did not answer.
    """
    counts: Counter[str] = Counter()
    findings: list[Finding] = []
    tell = progress or (lambda what: None)
    for look in (_artifacts(store, verify, counts, tell), _batches(store, counts), _tables(store, counts, tell)):
        findings.extend(look)
    try:
        orphans = tuple(collect(store, orphans_older_than_s, dry_run=True))
    except (CorruptError, StoreVersionError):
        orphans = ()  # it is among the findings already
    names = ("artifacts", "blobs", "bytes", "batches", "table_files", "rows", "outdated")
    return Survey({name: counts[name] for name in names}, tuple(findings), orphans)


def _artifacts(
    store: ArtifactStore, verify: bool, counts: Counter[str], tell: Callable[[str], None]
) -> Iterator[Finding]:
    for stage in store.backend.names("artifacts"):
        tell(f"artifacts of {stage}")
        for key in store.backend.names(f"artifacts/{stage}"):
            folder, problem = f"artifacts/{stage}/{key}", ""
            for generation in reversed(store.generations(stage, key)):
                try:
                    found = store.inspect(stage, key, generation, verify=verify)
                except StoreVersionError as error:
                    yield _newer(folder, error)
                    problem = ""
                    break
                if isinstance(found, Manifest):
                    data = store.backend.read(manifest_path(stage, key, generation))
                    counts["outdated"] += sealed_version(data, "manifest") < SCHEMA_VERSION
                    counts.update(artifacts=1, blobs=len(found.blobs), bytes=sum(blob.size for blob in found.blobs))
                    problem = ""
                    break
                problem = problem or found
            if problem:
                yield Finding("artifact", folder, problem, "made again by the next run that needs it")


def _batches(store: ArtifactStore, counts: Counter[str]) -> Iterator[Finding]:
    for name in list_batches(store):
        path = f"batches/{name}/manifest.json"
        try:
            read_batch(store, name)
            counts["batches"] += 1
        except StoreVersionError as error:
            yield _newer(path, error)
        except CorruptError as error:
            yield Finding("batch", path, str(error), "moved away; submit the list again under the same name")
        except UnknownBatchError:
            continue  # cancelled, then its manifest was moved away


def _tables(store: ArtifactStore, counts: Counter[str], tell: Callable[[str], None]) -> Iterator[Finding]:
    for table in store.backend.names("tables"):
        if table not in TABLES:
            yield Finding("unknown", f"tables/{table}", "no such table", "left alone; a newer version may know it")
            continue
        for folder in store.backend.names(f"tables/{table}"):
            tell(f"{table} {folder}")
            yield from _partition(Partition(store.backend, TABLES[table], folder.removeprefix("batch=")), counts)


def _partition(partition: Partition, counts: Counter[str]) -> Iterator[Finding]:
    folder = partition_folder(partition.schema.name, partition.batch)
    try:
        merged = [partition.merged_path(entry.name) for entry in partition.index().merged]
    except FileNotFoundError:
        merged = []  # replaced at this moment: whoever did it has just read every file
    except StoreVersionError as error:
        yield _newer(folder, error)
        return
    except CorruptError as error:
        yield Finding("index", folder, str(error), "made anew from the merged files")
        return
    for path in [*merged, *(f"{folder}/{name}" for name in partition.appended())]:
        found = read_part(partition, path, missing_is_damage=path in merged)
        if isinstance(found, Finding):
            yield found
        elif found is not None:
            counts.update(table_files=1, rows=found.rows.num_rows, outdated=found.version < partition.schema.version)


def read_part(partition: Partition, path: str, missing_is_damage: bool) -> Part | Finding | None:
    """A table's file, or what is wrong with it; None if it was merged meanwhile."""
    try:
        return from_parquet(partition.schema, partition.backend.read(path), path)
    except StoreVersionError as error:
        return _newer(path, error)
    except CorruptError as error:
        return Finding("table", path, str(error), "moved away: its rows are lost, the artifacts are not")
    except FileNotFoundError:
        try:
            gone = missing_is_damage and path in {partition.merged_path(e.name) for e in partition.index().merged}
        except FileNotFoundError:
            return None
        lost = "taken out of the index: its rows are lost, the artifacts are not"
        return Finding("table", path, "the file is missing", lost) if gone else None


def _newer(path: str, error: StoreVersionError) -> Finding:
    return Finding("newer", path, str(error), "left alone; install that version")
