"""Merging the files of a table loses and doubles no row, whoever merges, reads and appends at the same time."""

from __future__ import annotations

import math

import pytest

from storage_schema.partition import Index, Partition
from storage_schema.store import ArtifactStore
from storage_schema.tables import Tables
from tests.storage.table_rows import REQUIRED, frames, parquet_files


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
