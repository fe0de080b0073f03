"""Rows come back as they went in, and what is no row of ours is refused by name."""

from __future__ import annotations

import math
from datetime import datetime, timedelta, timezone
from typing import Any

import numpy as np
import pyarrow.compute as pc
import pytest

from storage_schema.errors import ArtifactError, CorruptError
from storage_schema.part_cache import PartCache
from storage_schema.rows import Part, rows_to_table
from storage_schema.schemas import TABLES
from storage_schema.tables import Tables
from tests.storage.table_rows import NOW, OPTIONAL, REQUIRED, STORED


@pytest.mark.parametrize("table", TABLES)
def test_every_column_of_every_table_comes_back_as_it_went_in(tables: Tables, table: str) -> None:
    full, bare = {**REQUIRED[table], **OPTIONAL[table]}, REQUIRED[table]
    assert set(full) == set(TABLES[table].columns.names), "this test covers all columns"
    tables.append(table, [full, bare], batch="b1")
    first, second = tables.read(table, "b1").to_pylist()
    assert first == {"batch": "b1", **full, **{name: STORED[name] for name in full if name in STORED}}
    assert second == {"batch": "b1", **dict.fromkeys(TABLES[table].columns.names), **bare}


@pytest.mark.parametrize("table", TABLES)
def test_an_empty_table_has_the_columns_of_a_full_one(tables: Tables, table: str) -> None:
    empty = tables.read(table)
    tables.append(table, [REQUIRED[table]], batch="b")
    assert empty.num_rows == 0 and empty.schema == tables.read(table).schema


def test_batches_are_kept_apart_and_read_together(tables: Tables) -> None:
    for batch in ("b1", "b2", "2024"):
        for frame in range(2):
            tables.append("frames", [{**REQUIRED["frames"], "frame": frame, "video_id": batch}], batch=batch)
    assert tables.batches("frames") == ["2024", "b1", "b2"]
    assert set(tables.read("frames", "b1")["video_id"].to_pylist()) == {"b1"}
    everything = tables.read("frames")
    assert everything.num_rows == 6 and everything["batch"].to_pylist() == everything["video_id"].to_pylist()


@pytest.mark.parametrize("filters", [[("frame", ">", 2), ("batch", "==", "b")], (pc.field("frame") > 2)])
def test_filters_keep_what_they_say(tables: Tables, filters: Any) -> None:
    tables.append("frames", [{**REQUIRED["frames"], "frame": frame} for frame in range(5)], batch="b")
    assert tables.read("frames", filters=filters)["frame"].to_pylist() == [3, 4]


def test_times_of_any_zone_are_the_same_moment(tables: Tables) -> None:
    zone = timezone(timedelta(hours=5, minutes=30))
    rows = [
        {**REQUIRED["stages"], "started_at": at} for at in (NOW, NOW.astimezone(zone), NOW.astimezone(zone).isoformat())
    ]
    tables.append("stages", rows, batch="b")
    assert tables.read("stages")["started_at"].to_pylist() == [NOW] * 3


@pytest.mark.parametrize(
    ("table", "change", "message"),
    [
        ("frames", {"colour": 1}, r"frames row 1: unknown columns \['colour'\]"),
        ("frames", {"pts": None}, "row 1, pts: expected double, got nothing"),
        ("frames", {"pts": "soon"}, "frames.pts: expected double"),
        ("frames", {"frame": 2**31}, "frames.frame: expected int32"),
        ("frames", {"K": np.eye(4)}, "frames.K: expected fixed_size_list"),
        ("frames", {"batch": "other"}, "batch 'other' is appended to batch 'b'"),
        ("stages", {"state": "finished"}, "state: expected one of"),
        ("stages", {"started_at": datetime(2026, 1, 1)}, "offset from UTC"),
        ("stages", {"knobs": {"x": math.nan}}, r"knobs\.x: expected a finite"),
    ],
)
def test_a_bad_row_is_refused_by_name_and_nothing_is_written(
    tables: Tables, table: str, change: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        tables.append(table, [REQUIRED[table], {**REQUIRED[table], **change}], batch="b")
    assert tables.batches(table) == []


def test_unknown_tables_and_bad_batches_are_refused(tables: Tables) -> None:
    with pytest.raises(ValueError, match="expected one of"):
        tables.read("nothing")
    for batch in ("../b", "", "a/b", ".b"):
        for use in (lambda b: tables.append("frames", [], batch=b), lambda b: tables.read("frames", b)):
            with pytest.raises(ArtifactError, match="batch: expected"):
                use(batch)


def test_what_is_remembered_of_tables_stays_within_its_limit() -> None:
    row = {**REQUIRED["frames"], "pose": np.zeros(100)}
    part = Part(rows_to_table(TABLES["frames"], [row], "b"), 1, frozenset())
    cache = PartCache(limit=3 * part.rows.nbytes)
    for n in range(6):
        for _ in range(2):
            cache.put(f"{n}", (), part)
        cache.get("0", ())
    kept = [n for n in range(6) if cache.get(f"{n}", ()) is not None]
    assert kept == [0, 4, 5], "what is used stays, the oldest of the others goes"


def test_columns_can_be_chosen_with_and_without_filters(tables: Tables) -> None:
    for n in range(3):
        tables.append("frames", [{**REQUIRED["frames"], "frame": n, "pts": n / 2}], batch="b")
    rows = tables.read("frames", "b", columns=["pts", "batch"]).to_pylist()
    assert rows == [{"pts": n / 2, "batch": "b"} for n in range(3)]
    late = tables.read("frames", "b", [("frame", ">", 1)], ["pts"])
    assert late.column_names == ["pts"] and late["pts"].to_pylist() == [1.0]
    assert tables.read("frames", "none", columns=["pts"]).column_names == ["pts"]


def test_secrets_are_taken_out_of_rows_as_they_are_written(tables: Tables) -> None:
    secret = "hunter2hunter2"
    url = f"https://me:{secret}@host/v.mp4?v=1&X-Amz-Signature={secret}"
    tables.append("videos", [{"video_id": "v", "source": url, "options": {"password": secret, "u": url}}], batch="b")
    failed = {"state": "failed", "error_message": f"403 for {url}", "knobs": {"note": url, "token": "[v]"}}
    tables.append("stages", [{**REQUIRED["stages"], **failed}], batch="b")
    rows = tables.read("videos").to_pylist() + tables.read("stages").to_pylist()
    assert secret not in str(rows)
    assert "host/v.mp4?v=1" in rows[0]["source"] and "[v]" in rows[1]["knobs"], "what is no secret stays"


@pytest.mark.parametrize("spoil", [lambda data: data[: len(data) // 2], lambda data: b"hello", lambda data: b""])
def test_a_file_that_is_not_ours_is_named(tables: Tables, spoil: Any) -> None:
    path = tables.append("frames", [REQUIRED["frames"]], batch="b")
    tables._backend.write(path, spoil(tables._backend.read(path)))
    with pytest.raises(CorruptError, match=path):
        tables.read("frames")


def test_a_file_in_the_wrong_tables_folder_is_named(tables: Tables) -> None:
    data = tables._backend.read(tables.append("frames", [REQUIRED["frames"]], batch="b"))
    tables._backend.write("tables/metrics/batch=b/x.parquet", data)
    with pytest.raises(CorruptError, match=r"x\.parquet holds rows of table frames"):
        tables.read("metrics")
