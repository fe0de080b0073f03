"""Parquet tables in the store: the ledger of stages, frames and metrics, partitioned by batch.

A file is written whole, once, under a name of its own, so that any number of workers append without knowing of each
other. Compacting writes one file that lists those it stands for; from then on readers ignore them, whether they have
been deleted yet or not.
"""

from __future__ import annotations

import io
import logging
import uuid
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from storage_schema.errors import CorruptError, StoreError
from storage_schema.keys import canonical_json
from storage_schema.manifest import check_name
from storage_schema.schemas import TABLES, TableSchema
from storage_schema.secrets import redact, redact_json
from storage_schema.store import ArtifactStore

__all__ = ["TABLES", "TableSchema", "Tables"]

_LOG = logging.getLogger(__name__)
_VERSION, _TABLE, _PARTS = b"ahoy.schema_version", b"ahoy.table", b"ahoy.parts"
_PARTITION = "batch="
# Files vanish under a reader only while somebody compacts; one compaction changes the listing a handful of times.
_READ_TRIES = 20


@dataclass(frozen=True)
class _Part:
    """One Parquet file: its rows at the current version, and the appended files that its rows came from."""

    name: str
    sources: frozenset[str]
    rows: pa.Table


class Tables:
    """The tables of a store.

    Args:
        store: where they are.
        schemas: by name.
    """

    def __init__(self, store: ArtifactStore, schemas: Mapping[str, TableSchema] = TABLES) -> None:
        self._backend = store.backend
        self._store = store
        self._schemas = schemas

    def append(self, table: str, rows: Iterable[Mapping[str, Any]], *, batch: str) -> str:
        """Add rows as one new file; either all of them are there afterwards or none.

        Args:
            table: its name.
            rows: column -> value. Optional columns may be left out. Arrays are flattened row by row, mappings in JSON
                columns become text, times may be ISO 8601 text with an offset. A `batch` in a row has to be the same as
                the argument.
            batch: the partition.

        Returns:
            Path of the new file, relative to the root of the store.

        Raises:
            ValueError: an unknown table or column, a missing value, or one of another type; nothing is written.
            StoreFullError: no room; nothing is there.
        """
        schema = self._schema(table)
        check_name(batch, "batch")
        data = _rows_to_table(schema, rows, batch)
        name = _new_name()
        path = f"{_folder(table, batch)}/{name}"
        self._backend.write(path, _to_parquet(schema, data, [name]))
        return path

    def read(
        self, table: str, batch: str | None = None, filters: Any = None, columns: Sequence[str] | None = None
    ) -> pa.Table:
        """All rows, with the current columns and `batch` as the first.

        Args:
            table: its name.
            batch: only this one; None for all.
            filters: what `pyarrow.parquet.read_table` takes: an expression, or tuples such as ("stage", "==",
                "ingest").
            columns: only these, in this order; filters may name others.

        Returns:
            The rows, files in the order in which they were written.

        Raises:
            ValueError: an unknown table.
            StoreVersionError: a file was written by a newer version of this software.
            CorruptError: a file is not what was written; the message names it.
        """
        schema = self._schema(table)
        tables = [_with_batch(schema.columns.empty_table(), "")]
        for name in [batch] if batch is not None else self.batches(table):
            check_name(name, "batch")
            for part in self._parts(schema, name):
                tables.append(_with_batch(part.rows, name))
        rows = pa.concat_tables(tables)
        if filters is not None:
            rows = rows.filter(
                filters if isinstance(filters, pa.compute.Expression) else pq.filters_to_expression(filters)
            )
        return rows if columns is None else rows.select(list(columns))

    def batches(self, table: str) -> list[str]:
        """Names of the batches that have rows in a table, sorted."""
        names = self._backend.names(f"tables/{self._schema(table).name}")
        return [name.removeprefix(_PARTITION) for name in names if name.startswith(_PARTITION)]

    def compact(self, table: str, batch: str) -> int:
        """Put all files of a batch into one of the current version. Readers and writers may go on meanwhile.

        Returns:
            How many files were replaced; 0 if there was nothing to do.

        Raises:
            StoreVersionError: a file was written by a newer version of this software; nothing is changed.
        """
        schema = self._schema(table)
        check_name(batch, "batch")
        folder = _folder(table, batch)
        parts = self._parts(schema, batch)
        old = self._files(folder)
        if len(parts) > 1:
            sources = sorted(set().union(*(part.sources for part in parts)))
            rows = pa.concat_tables([part.rows for part in parts])
            self._backend.write(f"{folder}/{_new_name()}", _to_parquet(schema, rows, sources))
        live = {part.name for part in self._parts(schema, batch)}
        done = [name for name in old if name not in live]
        for name in done:
            self._backend.remove(f"{folder}/{name}")
        return len(done)

    def _schema(self, table: str) -> TableSchema:
        if table not in self._schemas:
            raise ValueError(f"table {table!r}: expected one of {sorted(self._schemas)}")
        return self._schemas[table]

    def _files(self, folder: str) -> list[str]:
        """Files of a partition, listed until two listings agree: one taken while files change can miss some."""
        names = self._backend.names(folder)
        while (again := self._backend.names(folder)) != names:
            names = again
        return [name for name in names if name.endswith(".parquet")]

    def _parts(self, schema: TableSchema, batch: str) -> list[_Part]:
        """The files of a partition that count, in the order of their names."""
        folder = _folder(schema.name, batch)
        for _ in range(_READ_TRIES):
            try:
                parts = [self._part(schema, folder, name) for name in self._files(folder)]
            except FileNotFoundError:
                continue
            return _live(parts, folder)
        raise StoreError(f"{folder} kept changing while it was read; read it again once nobody compacts it")

    def _part(self, schema: TableSchema, folder: str, name: str) -> _Part:
        try:
            rows = pq.read_table(io.BytesIO(self._backend.read(f"{folder}/{name}")))
            metadata = rows.schema.metadata or {}
            version, table = int(metadata[_VERSION]), metadata[_TABLE].decode("utf-8")
            sources = frozenset(metadata[_PARTS].decode("utf-8").split("\n"))
        except (pa.ArrowException, KeyError, ValueError) as error:
            raise CorruptError(f"{folder}/{name} is not a table of this store ({error}); move it away") from error
        if table != schema.name:
            raise CorruptError(f"{folder}/{name} holds rows of table {table}, not {schema.name}; move it away")
        return _Part(name, sources, schema.upgraded(rows.replace_schema_metadata(), version))


def _live(parts: Sequence[_Part], folder: str) -> list[_Part]:
    """Drop the files that another one stands for; of two that stand for the same, the later counts."""
    # Only a compacted file can stand for others, and there are few.
    compacted = [part for part in parts if part.sources != {part.name}]

    def replaced(part: _Part) -> bool:
        return any(
            part.sources < other.sources or (part.sources == other.sources and part.name < other.name)
            for other in compacted
        )

    live = [part for part in parts if not replaced(part)]
    if sum(len(part.sources) for part in live) != len(frozenset().union(*(part.sources for part in live))):
        names = [part.name for part in live]
        raise CorruptError(f"{folder}: some of the files {names} hold the same rows; move the copies away")
    return live


def _with_batch(rows: pa.Table, batch: str) -> pa.Table:
    names = pa.array([batch] * rows.num_rows, pa.string())
    return rows.add_column(0, pa.field("batch", pa.string(), nullable=False), names)


def _rows_to_table(schema: TableSchema, rows: Iterable[Mapping[str, Any]], batch: str) -> pa.Table:
    plain = []
    for i, row in enumerate(rows):
        where = f"{schema.name} row {i}"
        if unknown := set(row) - set(schema.columns.names) - {"batch"}:
            raise ValueError(f"{where}: unknown columns {sorted(unknown)}, expected {schema.columns.names}")
        if row.get("batch", batch) != batch:
            raise ValueError(f"{where}: batch {row['batch']!r} is appended to batch {batch!r}")
        plain.append({column.name: _value(schema, column, row.get(column.name), where) for column in schema.columns})
    arrays = []
    for column in schema.columns:
        try:
            arrays.append(pa.array([row[column.name] for row in plain], column.type))
        except (pa.ArrowException, TypeError, OverflowError) as error:
            raise ValueError(f"{schema.name}.{column.name}: expected {column.type} ({error})") from error
    return pa.Table.from_arrays(arrays, schema=schema.columns)


def _value(schema: TableSchema, column: pa.Field, value: Any, where: str) -> Any:
    where = f"{where}, {column.name}"
    if value is None:
        if not column.nullable:
            raise ValueError(f"{where}: expected {column.type}, got nothing; this column is not optional")
        return None
    choices = schema.choices.get(column.name)
    if choices is not None and value not in choices:
        raise ValueError(f"{where}: expected one of {choices}, got {value!r}")
    if column.name in schema.json:
        return canonical_json(redact_json(value), where).decode("utf-8")
    if column.name in schema.redacted and isinstance(value, str):
        return redact(value)
    if pa.types.is_timestamp(column.type):
        return _time(value, where)
    if pa.types.is_list(column.type) or pa.types.is_fixed_size_list(column.type):
        return np.asarray(value, dtype=np.float32).reshape(-1)
    if isinstance(value, np.generic):
        return value.item()
    return value


def _time(value: Any, where: str) -> datetime:
    time = datetime.fromisoformat(value) if isinstance(value, str) else value
    if not isinstance(time, datetime) or time.tzinfo is None:
        raise ValueError(f"{where}: expected a time with its offset from UTC, got {value!r}; use datetime.now(UTC)")
    return time.astimezone(UTC)


def _to_parquet(schema: TableSchema, rows: pa.Table, sources: Sequence[str]) -> bytes:
    metadata = {
        _VERSION: str(schema.version).encode("ascii"),
        _TABLE: schema.name.encode("utf-8"),
        _PARTS: "\n".join(sources).encode("utf-8"),
    }
    buffer = io.BytesIO()
    pq.write_table(rows.replace_schema_metadata(metadata), buffer, compression="zstd")
    return buffer.getvalue()


def _folder(table: str, batch: str) -> str:
    return f"tables/{table}/{_PARTITION}{batch}"


def _new_name() -> str:
    return f"{datetime.now(UTC):%Y%m%dT%H%M%S%f}-{uuid.uuid4().hex[:8]}.parquet"
