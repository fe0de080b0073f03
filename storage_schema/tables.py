"""Parquet tables in the store: the ledger of stages and attempts, frames, metrics and more, partitioned by batch.

A file is written whole, once, under a name of its own, so that any number of workers append without knowing of each
other. Now and then an append puts small files together (`storage_schema.partition`), so that reading stays quick
however many there were.
"""

from __future__ import annotations

import hashlib
import logging
import uuid
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from storage_schema.errors import StoreError
from storage_schema.manifest import check_name
from storage_schema.part_cache import PartCache
from storage_schema.partition import Partition, partition_folder
from storage_schema.rows import rows_to_table, to_parquet
from storage_schema.schemas import TABLES, TableSchema
from storage_schema.store import ArtifactStore

__all__ = ["TABLES", "TableSchema", "Tables"]

_LOG = logging.getLogger(__name__)
_PARTITION = "batch="
# A reader opens at most about this many small files, at one to two milliseconds each.
MERGE_FROM = 128
# Listing a folder costs too much to be done at every append: about one in so many looks.
LOOK_EVERY = 32
_MERGE_LEASE_S = 60.0


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
        self._cache = PartCache()

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
        data = rows_to_table(schema, rows, batch)
        name = _new_name()
        path = f"{partition_folder(table, batch)}/{name}"
        self._backend.write(path, to_parquet(schema, data))
        if int(name[-16:-8], 16) % LOOK_EVERY == 0:
            self._tidy(table, batch)
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
        # A filter may be about any column.
        wanted = tuple(name for name in columns or () if name != "batch") if filters is None else ()
        empty = self._schema(table).columns.empty_table()
        tables = [_with_batch(empty.select(list(wanted)) if wanted else empty, "")]
        for name in [batch] if batch is not None else self.batches(table):
            parts = self._partition(table, name).snapshot(wanted).parts
            tables += [_with_batch(part.rows, name) for part in parts.values()]
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
        """Put small files of a batch together. Readers and writers may go on meanwhile; appending does it by itself.

        Returns:
            How many files were replaced; 0 if there was nothing to do.

        Raises:
            StoreVersionError: a file was written by a newer version of this software; nothing is changed.
        """
        return self._partition(table, batch).merge()

    def upgrade(self, table: str, batch: str) -> int:
        """Rewrite a batch's rows if some of its files are of an older version of the table.

        Returns:
            How many files were replaced; 0 if all are of the current version.

        Raises:
            CorruptError, StoreVersionError: a file cannot be read; nothing is changed.
        """
        return self._partition(table, batch).merge(everything=True) if self.is_outdated(table, batch) else 0

    def is_outdated(self, table: str, batch: str) -> bool:
        """Whether some of a batch's files are of an older version of the table."""
        partition = self._partition(table, batch)
        return any(part.version != partition.schema.version for part in partition.snapshot().parts.values())

    def _schema(self, table: str) -> TableSchema:
        if table not in self._schemas:
            raise ValueError(f"table {table!r}: expected one of {sorted(self._schemas)}")
        return self._schemas[table]

    def _partition(self, table: str, batch: str) -> Partition:
        schema = self._schema(table)
        check_name(batch, "batch")
        return Partition(self._backend, schema, batch, self._cache)

    def _tidy(self, table: str, batch: str) -> None:
        """Merge if there are many files, unless somebody else is at it. What goes wrong here is no fault of a row's."""
        partition = self._partition(table, batch)
        key = f"merge-{hashlib.sha256(partition.folder.encode()).hexdigest()}"
        try:
            if len(partition.appended()) < MERGE_FROM:
                return
            with self._store.lease(key, owner="append", ttl_s=_MERGE_LEASE_S) as held:
                if held:
                    partition.merge()
        except (OSError, StoreError) as error:
            _LOG.warning("%s could not be merged: %s", partition.folder, error)


def _with_batch(rows: pa.Table, batch: str) -> pa.Table:
    names = pa.array([batch] * rows.num_rows, pa.string())
    return rows.add_column(0, pa.field("batch", pa.string(), nullable=False), names)


def _new_name() -> str:
    return f"{datetime.now(UTC):%Y%m%dT%H%M%S%f}-{uuid.uuid4().hex[:8]}.parquet"
