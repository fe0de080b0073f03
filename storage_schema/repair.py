"""Takes what is damaged out of the way, so that runs, readers and merges go on without it; nothing is thrown away.

Damaged files are moved below `damaged/`, from where `ArtifactStore.gc` collects them when they are old.
"""

from __future__ import annotations

from collections.abc import Sequence

from storage_schema.collect import DAMAGED
from storage_schema.errors import CorruptError
from storage_schema.manifest import Manifest
from storage_schema.partition import Index, Merged, Partition
from storage_schema.rows import Part, from_parquet
from storage_schema.schemas import TABLES
from storage_schema.store import ArtifactStore, manifest_path
from storage_schema.survey import Finding

REPAIRABLE = ("artifact", "batch", "index", "table")


def repair(store: ArtifactStore, findings: Sequence[Finding]) -> tuple[Finding, ...]:
    """Repair what can be repaired.

    Args:
        store: the store; runs may go on meanwhile.
        findings: of `storage_schema.survey.survey`.

    Returns:
        The findings that stay: what a newer version of this software wrote.
    """
    for finding in findings:
        if finding.kind == "artifact":
            _repair_artifact(store, finding.path)
        elif finding.kind == "batch":
            _move_away(store, finding.path)
        elif finding.kind == "index":
            _repair_index(_partition_of(store, finding.path))
        elif finding.kind == "table":
            _repair_table(store, finding.path)
    return tuple(finding for finding in findings if finding.kind not in REPAIRABLE)


def _repair_artifact(store: ArtifactStore, folder: str) -> None:
    """Move its manifests away, unless one became whole meanwhile; what they named is an orphan then."""
    _, stage, key = folder.split("/")
    generations = store.generations(stage, key)
    if any(isinstance(store.inspect(stage, key, generation), Manifest) for generation in generations):
        return
    for generation in generations:
        _move_away(store, manifest_path(stage, key, generation))


def _repair_table(store: ArtifactStore, path: str) -> None:
    folder, _, name = path.rpartition("/")
    if folder.endswith("/merged"):
        partition = _partition_of(store, folder.removesuffix("/merged"))
        index = partition.index()
        left = tuple(entry for entry in index.merged if entry.name != name)
        if left != index.merged and not partition.publish(Index(index.number + 1, left)):
            return  # somebody merged meanwhile; the next check sees what is left to do
    _move_away(store, path)


def _repair_index(partition: Partition) -> None:
    """Put those merged files in force that hold every row whose appended file is gone, and none of them twice."""
    number = partition.head()
    parts: dict[str, Part] = {}
    for name in partition.backend.names(f"{partition.folder}/merged"):
        path = partition.merged_path(name)
        try:
            parts[name] = from_parquet(partition.schema, partition.backend.read(path), path)
        except (CorruptError, FileNotFoundError):
            continue
    there = frozenset(partition.appended())
    best = _disjoint({name: part.sources for name, part in parts.items()}, there)
    merged = tuple(
        Merged(name, parts[name].rows.num_rows, partition.backend.size(partition.merged_path(name)))
        for name in sorted(best, key=lambda name: min(parts[name].sources))
    )
    partition.publish(Index(number + 1, merged))


def _disjoint(sources: dict[str, frozenset[str]], there: frozenset[str]) -> tuple[str, ...]:
    """Of the sets of files without a common source, one that covers most sources which are not there any more.

    The files that were in force are such a set and cover all of them. There are few files, so all sets are tried.
    """
    best: tuple[int, tuple[str, ...]] = (0, ())
    stack: list[tuple[tuple[str, ...], frozenset[str], list[str]]] = [((), frozenset(), sorted(sources))]
    while stack:
        taken, covered, rest = stack.pop()
        best = max(best, (len(covered - there), taken), key=lambda choice: choice[0])
        for i, name in enumerate(rest):
            if covered.isdisjoint(sources[name]):
                stack.append(((*taken, name), covered | sources[name], rest[i + 1 :]))
    return best[1]


def _partition_of(store: ArtifactStore, folder: str) -> Partition:
    _, table, batch = folder.split("/")
    return Partition(store.backend, TABLES[table], batch.removeprefix("batch="))


def _move_away(store: ArtifactStore, path: str) -> None:
    """Copy first: a file is in one of the two places at any moment."""
    try:
        store.backend.write(f"{DAMAGED}/{path}", store.backend.read(path))
    except FileNotFoundError:
        return
    store.backend.remove(path)
