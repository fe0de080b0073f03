"""Rows of a table as Arrow columns, and Arrow columns as the bytes of a Parquet file."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from storage_schema.errors import CorruptError
from storage_schema.keys import canonical_json
from storage_schema.schemas import TableSchema
from storage_schema.secrets import redact, redact_json

_VERSION, _TABLE, _SOURCES = b"ahoy.schema_version", b"ahoy.table", b"ahoy.sources"


@dataclass(frozen=True)
class Part:
    """One Parquet file.

    Attributes:
        rows: at the current version of the schema.
        version: at which the file was written.
        sources: names of the appended files whose rows it holds; empty for an appended file itself.
    """

    rows: pa.Table
    version: int
    sources: frozenset[str]


def rows_to_table(schema: TableSchema, rows: Iterable[Mapping[str, Any]], batch: str) -> pa.Table:
    """Rows as the columns of a table.

    Raises:
        ValueError: an unknown column, a missing value, or one of another type; the message names row and column.
    """
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


def to_parquet(schema: TableSchema, rows: pa.Table, sources: Iterable[str] = ()) -> bytes:
    """Bytes of a Parquet file that says of which table and version it is.

    Args:
        schema: of the table.
        rows: with its current columns.
        sources: of a merged file: names of the appended files that its rows came from.
    """
    sink = pa.BufferOutputStream()
    metadata = {_VERSION: str(schema.version), _TABLE: schema.name, _SOURCES: "\n".join(sorted(sources))}
    with pq.ParquetWriter(sink, rows.schema, compression="zstd") as writer:
        writer.write_table(rows)
        writer.add_key_value_metadata({key.decode("ascii"): value for key, value in metadata.items()})
    return sink.getvalue().to_pybytes()


def from_parquet(schema: TableSchema, data: bytes, where: str, columns: Sequence[str] | None = None) -> Part:
    """Read what `to_parquet` wrote, at this or an older version.

    Args:
        schema: of the table.
        data: the bytes.
        where: how errors name the file.
        columns: only these.

    Raises:
        CorruptError: not a whole Parquet file of this table.
        StoreVersionError: a newer version of this software wrote it.
    """
    try:
        file = pq.ParquetFile(pa.BufferReader(data))
        metadata = file.metadata.metadata or {}
        version, table = int(metadata[_VERSION]), metadata[_TABLE].decode("utf-8")
        # Other columns are only of use to the upgrades.
        rows = file.read(list(columns) if columns and version == schema.version else None, use_threads=False)
    except (pa.ArrowException, OSError, KeyError, ValueError) as error:
        raise CorruptError(f"{where} is not a table of this store ({error}); `ahoy store check --repair`") from error
    if table != schema.name:
        raise CorruptError(f"{where} holds rows of table {table}, not {schema.name}; move it away")
    if not columns or version != schema.version:
        rows = schema.upgraded(rows.replace_schema_metadata(), version)
    if columns:
        rows = rows.select(list(columns)).cast(pa.schema([schema.columns.field(name) for name in columns]))
    sources = metadata.get(_SOURCES, b"").decode("utf-8")
    return Part(rows, version, frozenset(sources.split("\n")) if sources else frozenset())


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
