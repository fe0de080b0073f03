"""Rows of every older version are read as rows of the current one; newer ones are refused."""

from __future__ import annotations

import pyarrow as pa
import pyarrow.compute as pc
import pytest

from storage_schema.errors import StoreVersionError
from storage_schema.schemas import TABLES, TableSchema
from storage_schema.store import ArtifactStore
from storage_schema.tables import Tables
from tests.storage.table_rows import REQUIRED

V1 = TableSchema("toy", 1, pa.schema([pa.field("name", pa.string(), nullable=False), pa.field("seconds", pa.int32())]))


def _to_milliseconds(table: pa.Table) -> pa.Table:
    milliseconds = pc.multiply(table["seconds"].cast(pa.int64()), 1000)
    return table.drop_columns("seconds").append_column("milliseconds", milliseconds)


V2 = TableSchema(
    "toy", 2, pa.schema([pa.field("name", pa.string(), nullable=False), pa.field("milliseconds", pa.int64())]),
    upgrades={1: _to_milliseconds},
)  # fmt: skip
V3 = TableSchema(
    "toy", 3, pa.schema([pa.field("note", pa.string()), *V2.columns]),
    upgrades={1: _to_milliseconds, 2: lambda table: table.append_column("note", pa.nulls(table.num_rows, pa.string()))},
)  # fmt: skip


def test_rows_of_older_versions_are_upgraded_step_by_step_when_read_and_when_compacted(store: ArtifactStore) -> None:
    Tables(store, {"toy": V1}).append("toy", [{"name": "old", "seconds": 3}], batch="b")
    Tables(store, {"toy": V2}).append("toy", [{"name": "newer", "milliseconds": 5}], batch="b")
    current = Tables(store, {"toy": V3})
    current.append("toy", [{"name": "newest", "note": "n"}], batch="b")
    expected = [
        {"batch": "b", "note": None, "name": "old", "milliseconds": 3000},
        {"batch": "b", "note": None, "name": "newer", "milliseconds": 5},
        {"batch": "b", "note": "n", "name": "newest", "milliseconds": None},
    ]
    assert current.read("toy").to_pylist() == expected
    assert current.read("toy", columns=["note"]).to_pylist() == [{"note": row["note"]} for row in expected]
    assert current.compact("toy", "b") == 3
    assert current.read("toy").to_pylist() == expected


def test_stages_of_version_1_get_an_order_and_keep_everything_else(store: ArtifactStore) -> None:
    now = TABLES["stages"]
    columns = pa.schema([column for column in now.columns if column.name not in ("attempt_number", "seq")])
    v1 = {"stages": TableSchema("stages", 1, columns, choices=now.choices, json=now.json)}
    row = {name: value for name, value in REQUIRED["stages"].items() if name in columns.names}
    Tables(store, v1).append("stages", [row, {**row, "stage": "perceive"}], batch="b")
    first, second = Tables(store).read("stages", "b").to_pylist()
    assert first == {"batch": "b", **dict.fromkeys(now.columns.names), **row, "attempt_number": 1, "seq": 0}
    assert second["stage"] == "perceive"


def test_metrics_of_version_1_were_made_from_the_video_and_say_nothing_of_roles(store: ArtifactStore) -> None:
    now = TABLES["metrics"]
    columns = pa.schema([column for column in now.columns if column.name not in ("roles", "input_setting")])
    Tables(store, {"metrics": TableSchema("metrics", 1, columns)}).append("metrics", [REQUIRED["metrics"]], batch="b")
    assert Tables(store).read("metrics", "b").to_pylist() == [
        {"batch": "b", **dict.fromkeys(now.columns.names), **REQUIRED["metrics"], "input_setting": "video"}
    ]


def test_rows_of_older_versions_are_rewritten_in_place_once(store: ArtifactStore) -> None:
    old = Tables(store, {"toy": V1})
    old.append("toy", [{"name": "old", "seconds": 3}], batch="b")
    old.append("toy", [{"name": "older", "seconds": 4}], batch="b")
    old.compact("toy", "b")
    current = Tables(store, {"toy": V3})
    before = current.read("toy")
    assert current.upgrade("toy", "b") == 1 and current.upgrade("toy", "b") == 0
    assert current.read("toy") == before
    assert {part.version for part in current._partition("toy", "b").snapshot().parts.values()} == {3}


def test_rows_of_a_newer_version_are_refused_with_what_to_do_and_left_alone(store: ArtifactStore) -> None:
    Tables(store, {"toy": V3}).append("toy", [{"name": "new"}], batch="b")
    old = Tables(store, {"toy": V2})
    for use in (lambda: old.read("toy"), lambda: old.compact("toy", "b")):
        with pytest.raises(StoreVersionError, match=r"version 3, expected at most 2.*install that version"):
            use()
    assert Tables(store, {"toy": V3}).read("toy").num_rows == 1


def test_a_version_without_its_upgrades_cannot_be_declared() -> None:
    with pytest.raises(ValueError, match="expected an upgrade from each of"):
        TableSchema("toy", 3, V3.columns, upgrades={2: lambda table: table})
