"""The files of one table and batch, and how many small ones become few large ones.

    tables/<table>/batch=<batch>/<time>-<random>.parquet    appended, one file an append
    tables/<table>/batch=<batch>/merged/<random>.parquet    rows of many appended files; names those in its footer
    tables/<table>/batch=<batch>/index/000007.json          the merged files that count; the highest number is in force

Appending needs no agreement. Merging does: it writes a merged file that nobody knows yet, and then the index of the
next number by create-if-absent. Of two who merge at once one gets the number, and the other's file counts for nothing.
An appended file that a merged one in force names does not count, whether it has been deleted yet or not. So at every
moment each row counts exactly once, and no lease or clock is needed for that.
"""

from __future__ import annotations

import logging
import uuid
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field

import pyarrow as pa

from storage_schema.backend import Backend
from storage_schema.errors import CorruptError, StoreError
from storage_schema.part_cache import PartCache
from storage_schema.rows import Part, from_parquet, to_parquet
from storage_schema.schemas import TableSchema
from storage_schema.sealed import seal, unseal

_LOG = logging.getLogger(__name__)
INDEX_VERSION = 1
# Files vanish under a reader only while somebody merges; one merge changes the listing a handful of times.
_READ_TRIES = 20
# A merged file is taken into the next merge while it has fewer rows than this times what is merged already: each row is
# then written again only a few times for every tenfold growth of the table, and the merged files stay few.
_GROWTH = 4
# Merging holds its rows in memory, in a process that has better things to do with it.
_MERGE_BYTES = 64 << 20
# Older indexes are kept for readers whose listing is a moment old.
_KEPT_INDEXES = 3
_DOWNLOADS = 8


@dataclass(frozen=True)
class Merged:
    """A merged file that counts: its name, its rows, its bytes."""

    name: str
    rows: int
    bytes: int


@dataclass(frozen=True)
class Index:
    """The merged files in force, in the order of their rows; number 0 is a partition where nothing was merged."""

    number: int
    merged: tuple[Merged, ...] = ()


@dataclass(frozen=True)
class Snapshot:
    """What counts in a partition at one moment, by path, in the order of the rows."""

    index: Index
    parts: dict[str, Part]
    leftovers: tuple[str, ...]  # appended files that a merged one stands for


@dataclass
class Partition:
    """The files of one table and batch."""

    backend: Backend
    schema: TableSchema
    batch: str
    cache: PartCache = field(default_factory=PartCache)

    @property
    def folder(self) -> str:
        """Where it lies, relative to the root of the store."""
        return partition_folder(self.schema.name, self.batch)

    def appended(self) -> list[str]:
        """Names of the appended files, leftovers included, sorted."""
        return [name for name in self._listing(self.folder) if name.endswith(".parquet")]

    def head(self) -> int:
        """Number of the index in force, 0 if nothing was merged."""
        return max(self._numbers(), default=0)

    def index(self) -> Index:
        """The index in force.

        Raises:
            FileNotFoundError: it was replaced meanwhile; ask again.
            CorruptError, StoreVersionError: it cannot be read.
        """
        if not (number := self.head()):
            return Index(0)
        path = self._index_path(number)
        try:
            body = unseal(self.backend.read(path), "index", INDEX_VERSION, {})
            return Index(number, tuple(Merged(**merged) for merged in body["merged"]))
        except (CorruptError, KeyError, TypeError) as error:
            raise CorruptError(f"{path}: {error}; `ahoy store check --repair` makes it anew") from error

    def snapshot(self, columns: Sequence[str] = ()) -> Snapshot:
        """Read everything that counts.

        Args:
            columns: only these; all if empty.

        Raises:
            CorruptError, StoreVersionError: a file cannot be read; the message names it.
            StoreError: it kept changing.
        """
        for _ in range(_READ_TRIES):
            try:
                index = self.index()
                appended = self.appended()
                merged = self._read([self.merged_path(entry.name) for entry in index.merged], columns)
                absorbed = frozenset[str]().union(*(part.sources for part in merged.values()))
                live = [f"{self.folder}/{name}" for name in appended if name not in absorbed]
                parts = merged | self._read(live, columns)
            except FileNotFoundError:
                continue
            if self.head() == index.number:
                return Snapshot(index, parts, tuple(name for name in appended if name in absorbed))
        raise StoreError(f"{self.folder} kept changing while it was read; read it again once nobody merges it")

    def merge(self, everything: bool = False) -> int:
        """Put the appended files, and small merged ones, into one. Readers and writers may go on meanwhile.

        Args:
            everything: all merged files too, whatever their size, so that all are of the current version.

        Returns:
            How many files were replaced; 0 if there was nothing to do or somebody else was faster.

        Raises:
            CorruptError, StoreVersionError: a file cannot be read; nothing is changed.
            StoreFullError: no room; nothing is changed.
        """
        snapshot = self.snapshot()
        self._remove(f"{self.folder}/{name}" for name in snapshot.leftovers)
        count = len(snapshot.index.merged)
        merged, appended = list(snapshot.parts.items())[:count], list(snapshot.parts.items())[count:]
        kept = 0 if everything else _kept(snapshot.index.merged, appended)
        taken = merged[kept:] + (appended if everything else _until_large(appended))
        if len(taken) < 2 and not (everything and taken):
            return len(snapshot.leftovers)
        entry = self._write_merged(taken)
        index = Index(snapshot.index.number + 1, (*snapshot.index.merged[:kept], entry))
        if not self.publish(index):
            self.backend.remove(self.merged_path(entry.name))
            return len(snapshot.leftovers)
        # Only who has the head may delete what it replaces: a number below the head decides nothing.
        if self.head() == index.number:
            self._remove(path for path, _ in taken)
            self._remove(self._index_path(n) for n in self._numbers() if n <= index.number - _KEPT_INDEXES)
        return len(taken) + len(snapshot.leftovers)

    def publish(self, index: Index) -> bool:
        """Put an index in force, if its number is free; whether it is."""
        path = self._index_path(index.number)
        data = seal({"schema_version": INDEX_VERSION, "merged": [asdict(entry) for entry in index.merged]}, "index")
        # The answer to our own write may be lost on the way; a client that asks again is told that the file is there.
        return self.backend.create(path, data) or self.backend.read(path) == data

    def orphans(self) -> list[str]:
        """Merged files that are not in force: of a merge that was killed or lost; or one that is about to publish."""
        for _ in range(_READ_TRIES):
            try:
                # Listed before the index is read, so that one that is published meanwhile is seen.
                names = self._listing(f"{self.folder}/merged")
                live = {entry.name for entry in self.index().merged}
            except FileNotFoundError:
                continue
            return [self.merged_path(name) for name in names if name not in live]
        raise StoreError(f"{self.folder} kept changing while it was read; try again once nobody merges it")

    def merged_path(self, name: str) -> str:
        """Where a merged file lies, relative to the root of the store."""
        return f"{self.folder}/merged/{name}"

    def _write_merged(self, taken: Sequence[tuple[str, Part]]) -> Merged:
        sources: set[str] = set()
        for path, part in taken:
            sources |= part.sources or {path.rsplit("/", 1)[1]}
        rows = pa.concat_tables([part.rows for _, part in taken])
        data = to_parquet(self.schema, rows, sources)
        name = f"{uuid.uuid4().hex}.parquet"
        self.backend.write(self.merged_path(name), data)
        return Merged(name, rows.num_rows, len(data))

    def _read(self, paths: Sequence[str], columns: Sequence[str]) -> dict[str, Part]:
        found = {path: self.cache.get(path, columns) for path in paths}
        missing = [path for path, part in found.items() if part is None]

        def load(path: str) -> Part:
            return from_parquet(self.schema, self.backend.read(path), path, columns)

        for path, part in zip(missing, self._map(load, missing), strict=True):
            self.cache.put(path, columns, part)
            found[path] = part
        return {path: part for path, part in found.items() if part is not None}

    def _map(self, work: Callable[[str], Part], paths: Sequence[str]) -> Iterable[Part]:
        """Side by side where each file is a round trip."""
        if self.backend.local("") is not None or len(paths) < 2:
            return map(work, paths)
        with ThreadPoolExecutor(_DOWNLOADS) as pool:
            return list(pool.map(work, paths))

    def _remove(self, paths: Iterable[str]) -> None:
        """Delete what does not count any more. A failure costs space, and the next merge tries again."""
        for path in paths:
            try:
                self.backend.remove(path)
            except OSError as error:
                _LOG.warning("%s could not be deleted: %s", path, error)

    def _numbers(self) -> list[int]:
        stems = (name.removesuffix(".json") for name in self._listing(f"{self.folder}/index"))
        return [int(stem) for stem in stems if stem.isdecimal()]

    def _index_path(self, number: int) -> str:
        return f"{self.folder}/index/{number:06d}.json"

    def _listing(self, folder: str) -> list[str]:
        """Names in a folder, listed until two listings agree: one taken while files change can miss some."""
        names = self.backend.names(folder)
        while (again := self.backend.names(folder)) != names:
            names = again
        return names


def partition_folder(table: str, batch: str) -> str:
    """Where a table's rows of a batch lie, relative to the root of the store."""
    return f"tables/{table}/batch={batch}"


def _kept(merged: Sequence[Merged], appended: Sequence[tuple[str, Part]]) -> int:
    """How many of the merged files, from the first, are too large to be written again for so few new rows."""
    rows, size, kept = sum(part.rows.num_rows for _, part in appended), 0, len(merged)
    while kept and merged[kept - 1].rows < _GROWTH * rows and size + merged[kept - 1].bytes <= _MERGE_BYTES:
        kept -= 1
        rows, size = rows + merged[kept].rows, size + merged[kept].bytes
    return kept


def _until_large(appended: Sequence[tuple[str, Part]]) -> list[tuple[str, Part]]:
    taken: list[tuple[str, Part]] = []
    size = 0
    for path, part in appended:
        if taken and size + part.rows.nbytes > _MERGE_BYTES:
            break
        taken.append((path, part))
        size += part.rows.nbytes
    return taken
