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
from storage_schema.part_cache import PartCache
from storage_schema.partition import Index, Partition
from storage_schema.rows import Part, rows_to_table
from storage_schema.schemas import TABLES, TableSchema
from storage_schema.store import ArtifactStore
from storage_schema.tables import Tables

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


def parquet_files(tables: Tables, table: str = "frames") -> list[str]:
    return [path for path in tables._backend.files(f"tables/{table}/batch=b") if path.endswith(".parquet")]


def test_compacting_keeps_rows_and_their_order_in_one_file(tables: Tables) -> None:
    for n in range(5):
        tables.append("frames", [{**REQUIRED["frames"], "frame": n}], batch="b")
    tables.append("frames", [REQUIRED["frames"]], batch="other")
    before = tables.read("frames")
    assert tables.compact("frames", "b") == 5
    assert tables.read("frames") == before and len(parquet_files(tables)) == 1
    for n in range(5, 7):
        tables.append("frames", [{**REQUIRED["frames"], "frame": n}], batch="b")
    assert tables.compact("frames", "b") == 3
    assert tables.read("frames", "b")["frame"].to_pylist() == list(range(7))
    assert tables.compact("frames", "b") == 0


def test_columns_can_be_chosen_with_and_without_filters(tables: Tables) -> None:
    for n in range(3):
        tables.append("frames", [{**REQUIRED["frames"], "frame": n, "pts": n / 2}], batch="b")
    rows = tables.read("frames", "b", columns=["pts", "batch"]).to_pylist()
    assert rows == [{"pts": n / 2, "batch": "b"} for n in range(3)]
    late = tables.read("frames", "b", [("frame", ">", 1)], ["pts"])
    assert late.column_names == ["pts"] and late["pts"].to_pylist() == [1.0]
    assert tables.read("frames", "none", columns=["pts"]).column_names == ["pts"]


@pytest.fixture
def eager(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every append looks whether there is something to merge."""
    monkeypatch.setattr("storage_schema.tables.LOOK_EVERY", 1)


@pytest.mark.usefixtures("eager")
def test_appending_keeps_the_files_few_without_anybody_asking(
    disk_store: ArtifactStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("storage_schema.tables.MERGE_FROM", limit := 12)
    tables = Tables(disk_store)
    rows = 10 * limit
    for n in range(rows):
        tables.append("effects", [{**REQUIRED["effects"], "video_id": str(n)}], batch="b")
    assert [int(v) for v in Tables(disk_store).read("effects", "b")["video_id"].to_pylist()] == list(range(rows))
    assert len(parquet_files(tables, "effects")) < limit + 4
    assert len(disk_store.backend.files("tables")) < limit + 8, "old indexes go too"
    assert disk_store.backend.files("leases") == []


@pytest.mark.usefixtures("eager")
def test_a_merge_that_cannot_be_done_stops_no_append(
    disk_store: ArtifactStore, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("storage_schema.tables.MERGE_FROM", 2)
    tables = Tables(disk_store)
    disk_store.backend.write("tables/frames/batch=b/20260101T000000000000-00000000.parquet", b"spoilt")
    for n in range(3):
        tables.append("frames", [{**REQUIRED["frames"], "frame": n}], batch="b")
    assert len(parquet_files(tables)) == 4 and "could not be merged" in caplog.text


def test_merged_files_stay_few_and_rows_are_written_again_only_a_few_times(
    disk_store: ArtifactStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    written = []
    real = Partition._write_merged
    monkeypatch.setattr(Partition, "_write_merged", lambda self, taken: written.append(m := real(self, taken)) or m)
    tables, total, each = Tables(disk_store), 40, 2
    for n in range(total):
        for k in range(each):
            tables.append("frames", [{**REQUIRED["frames"], "frame": each * n + k}], batch="b")
        tables.compact("frames", "b")
    partition = tables._partition("frames", "b")
    rows = total * each
    assert len(partition.index().merged) <= math.log(total, 4) + 2  # a geometric series of sizes
    assert sum(m.rows for m in written) <= rows * 4 * (math.log(total, 4) + 1)  # 4: see _GROWTH
    assert tables.read("frames", "b")["frame"].to_pylist() == list(range(rows))


def test_what_was_read_is_not_read_again(disk_store: ArtifactStore, monkeypatch: pytest.MonkeyPatch) -> None:
    tables = Tables(disk_store)
    _three_rows(tables)
    real, reads = disk_store.backend.read, []
    monkeypatch.setattr(disk_store.backend, "read", lambda path: reads.append(path) or real(path))
    tables.read("frames", "b")
    tables.append("frames", [{**REQUIRED["frames"], "frame": 3}], batch="b")
    assert tables.read("frames", "b")["frame"].to_pylist() == [0, 1, 2, 3]
    assert len([path for path in reads if path.endswith(".parquet")]) == 4


def _three_rows(tables: Tables) -> None:
    for n in range(3):
        tables.append("frames", [{**REQUIRED["frames"], "frame": n}], batch="b")


def frames(tables: Tables) -> list[int]:
    return Tables(tables._store).read("frames", "b")["frame"].to_pylist()


def test_of_two_who_merge_the_same_rows_at_once_one_counts(
    store: ArtifactStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    tables = Tables(store)
    _three_rows(tables)
    slow = tables._partition("frames", "b")
    monkeypatch.setattr(
        slow, "publish", lambda index: Tables(store).compact("frames", "b") and Partition.publish(slow, index)
    )
    slow.merge()
    assert frames(tables) == [0, 1, 2] and len(parquet_files(tables)) == 1


def test_a_merge_that_wakes_up_when_its_number_was_used_and_forgotten_changes_nothing(
    store: ArtifactStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    tables = Tables(store)
    _three_rows(tables)
    slow = tables._partition("frames", "b")

    def publish(index: Index) -> bool:
        for n in range(3, 13, 2):
            for frame in (n, n + 1):
                tables.append("frames", [{**REQUIRED["frames"], "frame": frame}], batch="b")
            assert tables.compact("frames", "b")
        assert f"{index.number:06d}.json" not in store.backend.names("tables/frames/batch=b/index")
        return Partition.publish(slow, index)

    monkeypatch.setattr(slow, "publish", publish)
    slow.merge()
    assert frames(tables) == list(range(13))
    for n in range(13, 15):
        tables.append("frames", [{**REQUIRED["frames"], "frame": n}], batch="b")
    assert tables.compact("frames", "b") and frames(tables) == list(range(15))


def test_a_number_below_the_head_decides_nothing_though_it_was_free(
    store: ArtifactStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    tables = Tables(store)
    _three_rows(tables)
    slow = tables._partition("frames", "b")

    def publish(index: Index) -> bool:
        # Others went on to number 5 without these rows, and the number this merge is about to use was cleared away.
        for number in range(1, 6):
            assert Partition.publish(slow, Index(number))
        store.backend.remove(f"tables/frames/batch=b/index/{index.number:06d}.json")
        return Partition.publish(slow, index)

    monkeypatch.setattr(slow, "publish", publish)
    slow.merge()
    assert frames(tables) == [0, 1, 2]


def test_an_appended_file_that_comes_back_after_it_was_merged_is_not_counted_twice(store: ArtifactStore) -> None:
    tables = Tables(store)
    _three_rows(tables)
    before = {path: store.backend.read(path) for path in parquet_files(tables)}
    tables.compact("frames", "b")
    for path, data in before.items():
        store.backend.write(path, data)  # a client that sends again what it believes lost
    assert frames(tables) == [0, 1, 2]
    assert tables.compact("frames", "b") == 3 and len(parquet_files(tables)) == 1


@pytest.mark.parametrize("when", ["before its listing", "after its listing"])
def test_a_reader_overtaken_by_a_merge_reads_again(
    store: ArtifactStore, monkeypatch: pytest.MonkeyPatch, when: str
) -> None:
    tables, calls = Tables(store), []
    _three_rows(tables)
    real = Partition.appended

    def overtaken(self: Partition) -> list[str]:
        names = real(self)
        calls.append(names)
        if len(calls) == 1:
            Tables(store).compact("frames", "b")
            return real(self) if when == "before its listing" else names
        return names

    monkeypatch.setattr(Partition, "appended", overtaken)
    assert tables.read("frames", "b")["frame"].to_pylist() == [0, 1, 2]
    assert len(calls) == 3, "the reader, the merge, the reader again"


def test_a_listing_taken_while_files_change_is_not_believed(tables: Tables, monkeypatch: pytest.MonkeyPatch) -> None:
    _three_rows(tables)
    real, listings = tables._backend.names, []

    def names(path: str) -> list[str]:
        listings.append(path)
        return real(path)[1:] if listings.count(path) == 1 else real(path)

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


def test_secrets_are_taken_out_of_rows_as_they_are_written(tables: Tables) -> None:
    secret = "hunter2hunter2"
    url = f"https://me:{secret}@host/v.mp4?v=1&X-Amz-Signature={secret}"
    tables.append("videos", [{"video_id": "v", "source": url, "options": {"password": secret, "u": url}}], batch="b")
    failed = {"state": "failed", "error_message": f"403 for {url}", "knobs": {"note": url, "token": "[v]"}}
    tables.append("stages", [{**REQUIRED["stages"], **failed}], batch="b")
    rows = tables.read("videos").to_pylist() + tables.read("stages").to_pylist()
    assert secret not in str(rows)
    assert "host/v.mp4?v=1" in rows[0]["source"] and "[v]" in rows[1]["knobs"], "what is no secret stays"


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
