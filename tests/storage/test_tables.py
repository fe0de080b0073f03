"""Rows come back as they went in, whichever version wrote them."""

from __future__ import annotations

import math
from datetime import UTC, datetime, timedelta, timezone
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest

from storage_schema.errors import ArtifactError, CorruptError, StoreVersionError
from storage_schema.schemas import TABLES, TableSchema
from storage_schema.store import ArtifactStore
from storage_schema.tables import Tables, _to_parquet

NOW = datetime(2026, 1, 2, 3, 4, 5, 678901, tzinfo=UTC)
REQUIRED: dict[str, dict[str, Any]] = {
    "videos": {"video_id": "v", "source": "https://host/v.mp4"},
    "attempts": {"video_id": "v", "run_id": "r", "attempt_number": 1, "seq": 0, "state": "running", "at": NOW},
    "effects": {
        "video_id": "v",
        "key": "k",
        "scene": "s",
        "effect": "shadow",
        "enabled": False,
        "reason": "no ground in the scene",
    },
    "stages": {
        "attempt_number": 2,
        "seq": 7,
        "video_id": "v",
        "run_id": "r",
        "stage": "ingest",
        "stage_version": 1,
        "state": "done",
        "started_at": NOW,
        "wall_s": 0.1,
    },
    "frames": {"video_id": "v", "key": "k", "frame": 0, "index": 2**40, "pts": 0.1, "used": True, "confidence": 0.5},
    "metrics": {
        "video_id": "v",
        "key": "k",
        "capture": "c",
        "config": "full",
        "protocol": "p",
        "protocol_id": "id",
        "region": "mask",
        "camera": "0",
        "frame": 0,
    },
}
OPTIONAL: dict[str, dict[str, Any]] = {
    "videos": {
        "content_hash": "h",
        "title": "<b>walk</b>",
        "duration_s": 4.5,
        "fps": 29.97,
        "width": 640,
        "height": 360,
        "frames": 135,
        "options": {"subject": 1},
    },
    "attempts": {
        "stage": "coarse",
        "flow_run_id": "f",
        "worker": "host:12",
        "error_class": "OSError",
        "error_message": "gone",
        "wall_s": 2.5,
        "cpu_s": 1.5,
    },
    "effects": {"predicted_s": 0.5, "measured_s": 0.25},
    "stages": {
        "attempt": "a",
        "key": "k",
        "reason": "no face",
        "error_class": "ValueError",
        "error_message": "é\n",
        "cpu_s": 0.3,
        "peak_rss_mb": 12.5,
        "knobs": {"b": 0.1, "a": [1, None]},
        "accuracy": {"px": 3.5},
    },
    "frames": {
        "pose": np.arange(6).reshape(2, 3),
        "transl": [0, 1, 2],
        "K": np.eye(3),
        "viewmat": np.eye(4),
        "box": (0, 1, 2, 3),
    },
    "metrics": {"psnr": math.inf, "ssim": 0.5, "perceptual": 0.25, "perceptual_name": "net", "iou": 1.0},
}
STORED = {
    "knobs": '{"a":[1,null],"b":0.1}',
    "accuracy": '{"px":3.5}',
    "options": '{"subject":1}',
    "pose": [0, 1, 2, 3, 4, 5],
    "transl": [0, 1, 2],
    "K": [1, 0, 0, 0, 1, 0, 0, 0, 1],
    "viewmat": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1],
    "box": [0, 1, 2, 3],
}


@pytest.fixture
def tables(store: ArtifactStore) -> Tables:
    return Tables(store)


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


def test_compacting_keeps_rows_and_their_order_in_one_file(tables: Tables) -> None:
    for n in range(5):
        tables.append("frames", [{**REQUIRED["frames"], "frame": n}], batch="b")
    tables.append("frames", [REQUIRED["frames"]], batch="other")
    before = tables.read("frames")
    assert tables.compact("frames", "b") == 5
    assert tables.read("frames") == before and len(tables._backend.files("tables/frames/batch=b")) == 1
    tables.append("frames", [{**REQUIRED["frames"], "frame": 5}], batch="b")
    assert tables.compact("frames", "b") == 2
    assert tables.read("frames", "b")["frame"].to_pylist() == list(range(6))
    assert tables.compact("frames", "b") == 0


def _three_rows(tables: Tables) -> None:
    for n in range(3):
        tables.append("frames", [{**REQUIRED["frames"], "frame": n}], batch="b")


def test_two_compactions_of_the_same_rows_at_the_same_time_double_nothing(tables: Tables) -> None:
    _three_rows(tables)
    backend, folder = tables._backend, "tables/frames/batch=b"
    appended = {path: backend.read(path) for path in backend.files(folder)}
    tables.compact("frames", "b")
    (compacted,) = backend.files(folder)
    backend.write(f"{folder}/29990101T000000000000-00000000.parquet", backend.read(compacted))
    for path, data in appended.items():
        backend.write(path, data)
    assert tables.read("frames")["frame"].to_pylist() == [0, 1, 2]
    assert tables.compact("frames", "b") == 4
    assert tables.read("frames")["frame"].to_pylist() == [0, 1, 2]


def test_files_that_hold_some_of_the_same_rows_are_refused(store: ArtifactStore) -> None:
    tables = Tables(store)
    rows = TABLES["frames"].columns.empty_table()
    for name, sources in (("x", ["a", "b"]), ("y", ["b", "c"])):
        data = _to_parquet(TABLES["frames"], rows, sources)
        store.backend.write(f"tables/frames/batch=b/{name}.parquet", data)
    with pytest.raises(CorruptError, match="hold the same rows"):
        tables.read("frames")


def test_a_reader_overtaken_by_a_compaction_reads_again(store: ArtifactStore) -> None:
    class Overtaken(Tables):
        calls = 0

        def _files(self, folder: str) -> list[str]:
            names = super()._files(folder)
            self.calls += 1
            if self.calls == 1:
                Tables(store).compact("frames", "b")
            return names

    tables = Overtaken(store)
    _three_rows(tables)
    assert tables.read("frames")["frame"].to_pylist() == [0, 1, 2]
    assert tables.calls == 2


def test_a_listing_taken_while_files_change_is_not_believed(tables: Tables, monkeypatch: pytest.MonkeyPatch) -> None:
    _three_rows(tables)
    real, listings = tables._backend.names, []

    def names(path: str) -> list[str]:
        listings.append(path)
        return real(path)[1:] if len(listings) == 1 else real(path)

    monkeypatch.setattr(tables._backend, "names", names)
    assert tables.read("frames", "b")["frame"].to_pylist() == [0, 1, 2]


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


def test_secrets_are_taken_out_of_rows_as_they_are_written(tables: Tables) -> None:
    secret = "hunter2hunter2"
    url = f"https://me:{secret}@host/v.mp4?v=1&X-Amz-Signature={secret}"
    tables.append("videos", [{"video_id": "v", "source": url, "options": {"password": secret, "u": url}}], batch="b")
    failed = {"state": "failed", "error_message": f"403 for {url}", "knobs": {"note": url, "token": "[v]"}}
    tables.append("stages", [{**REQUIRED["stages"], **failed}], batch="b")
    rows = tables.read("videos").to_pylist() + tables.read("stages").to_pylist()
    assert secret not in str(rows)
    assert "host/v.mp4?v=1" in rows[0]["source"] and "[v]" in rows[1]["knobs"], "what is no secret stays"


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
