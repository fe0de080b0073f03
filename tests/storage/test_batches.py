"""A batch's manifest is written once, by whoever comes first, and says what differs to all others."""

from __future__ import annotations

import threading
from dataclasses import replace

import pytest

from storage_schema.batches import (
    BATCH_VERSION,
    BatchEntry,
    BatchManifest,
    cancel_batch,
    is_cancelled,
    list_batches,
    read_batch,
    resume_batch,
    submit,
)
from storage_schema.errors import ArtifactError, BatchExistsError, CorruptError, StoreVersionError, UnknownBatchError
from storage_schema.store import ArtifactStore

ENTRIES = (
    BatchEntry("walk", "https://host/walk.mp4", 1),
    BatchEntry("desk", "/clips/desk.mp4", 3, {"subject": 1, "span": [0.5, 2]}),
)


def manifest(batch: str = "b", entries: tuple[BatchEntry, ...] = ENTRIES, **defaults: object) -> BatchManifest:
    return BatchManifest.of(batch, entries, {"preset": "draft", **defaults})


def test_what_was_submitted_comes_back_to_anybody(store: ArtifactStore) -> None:
    mine, new = submit(store, manifest())
    assert new and read_batch(store, "b") == mine
    assert mine.entry("desk").options == {"subject": 1, "span": [0.5, 2]} and mine.entry("walk").line == 1
    submit(store, manifest("a"))
    assert list_batches(store) == ["a", "b"]


def test_a_second_submit_of_the_same_list_finds_the_first(store: ArtifactStore) -> None:
    first, _ = submit(store, manifest())
    moved = tuple(replace(entry, line=entry.line + 5) for entry in reversed(ENTRIES))  # a comment went in above
    again, new = submit(store, replace(manifest(entries=moved), created_at="2030-01-01T00:00:00.000+00:00"))
    assert not new and again == first


@pytest.mark.parametrize(
    ("other", "message"),
    [
        (manifest(entries=(*ENTRIES, BatchEntry("sofa", "s.mp4"))), "new here: sofa"),
        (manifest(entries=ENTRIES[:1]), "missing here: desk"),
        (manifest(entries=(replace(ENTRIES[0], source="other.mp4"), ENTRIES[1])), "another source: walk"),
        (manifest(entries=(ENTRIES[0], replace(ENTRIES[1], options={"subject": 2}))), "other options: desk"),
        (manifest(preset="high"), "other defaults: preset"),
        (manifest(stages=None), "other defaults: stages"),
        (
            manifest(entries=tuple(BatchEntry(f"v{i}", "x") for i in range(9))),
            "new here: v0, v1, v2, v3, v4 and 4 more; missing here: desk, walk",
        ),
    ],
)
def test_another_list_under_the_same_name_is_refused_with_what_differs(
    store: ArtifactStore, other: BatchManifest, message: str
) -> None:
    first, _ = submit(store, manifest())
    with pytest.raises(BatchExistsError, match=message):
        submit(store, other)
    assert read_batch(store, "b") == first


def test_of_many_who_submit_at_once_one_writes_and_all_get_the_same(store: ArtifactStore) -> None:
    barrier, results = threading.Barrier(8), []

    def work(number: int) -> None:
        mine = replace(manifest(), created_at=f"2030-01-01T00:00:0{number}.000+00:00")
        barrier.wait()
        results.append(submit(store, mine))

    threads = [threading.Thread(target=work, args=(n,)) for n in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [new for _, new in results].count(True) == 1
    assert {found.created_at for found, _ in results} == {read_batch(store, "b").created_at}


def test_credentials_never_reach_the_store(store: ArtifactStore) -> None:
    secret = "hunter2hunter2"
    entry = BatchEntry("v", f"https://me:{secret}@host/v.mp4?id=3&sig={secret}", 1, {"headers": {"cookie": secret}})
    submit(store, manifest(entries=(entry,), proxy=f"http://u:{secret}@proxy"))
    cancel_batch(store, "b", f"password={secret}")
    for path in store.backend.files("batches"):
        assert secret.encode() not in store.backend.read(path)
    assert "host/v.mp4?id=3" in read_batch(store, "b").entries[0].source


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ((), "at least one video"),
        ((BatchEntry("a", "x", 3), BatchEntry("a", "y", 9)), "lines 3 and 9 have the same video_id 'a'"),
        ((BatchEntry("../a", "x", 4),), "video_id of line 4"),
    ],
)
def test_bad_lists_are_refused_by_line(entries: tuple[BatchEntry, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        manifest(entries=entries)


def test_an_unknown_batch_is_named_with_those_there_are(store: ArtifactStore) -> None:
    with pytest.raises(UnknownBatchError, match="it has none yet"):
        read_batch(store, "b")
    submit(store, manifest("monday"))
    with pytest.raises(UnknownBatchError, match="it has monday"):
        read_batch(store, "mondays")
    with pytest.raises(ArtifactError, match="batch: expected"):
        read_batch(store, "../b")


@pytest.mark.parametrize("spoil", [lambda d: d[: len(d) // 2], lambda d: b"", lambda d: d.replace(b"walk", b"wolf")])
def test_a_damaged_manifest_says_what_to_do_and_is_not_overwritten(store: ArtifactStore, spoil: object) -> None:
    submit(store, manifest())
    path = "batches/b/manifest.json"
    data = spoil(store.backend.read(path))  # type: ignore[operator]
    store.backend.write(path, data)
    for use in (lambda: read_batch(store, "b"), lambda: submit(store, manifest())):
        with pytest.raises(CorruptError, match="Move the file away and submit the list again"):
            use()
    assert store.backend.read(path) == data and list_batches(store) == ["b"]


def test_a_manifest_of_a_newer_version_is_refused_and_not_overwritten(store: ArtifactStore) -> None:
    newer = replace(manifest(), schema_version=BATCH_VERSION + 1).to_json()
    store.backend.write("batches/b/manifest.json", newer)
    for use in (lambda: read_batch(store, "b"), lambda: submit(store, manifest())):
        with pytest.raises(StoreVersionError, match="install that version"):
            use()
    assert store.backend.read("batches/b/manifest.json") == newer


def test_a_batch_can_be_cancelled_once_and_resumed(store: ArtifactStore) -> None:
    submit(store, manifest())
    assert not is_cancelled(store, "b")
    assert cancel_batch(store, "b", "wrong list") and not cancel_batch(store, "b")
    assert is_cancelled(store, "b")
    resume_batch(store, "b")
    resume_batch(store, "b")
    assert not is_cancelled(store, "b")
    with pytest.raises(UnknownBatchError):
        cancel_batch(store, "c")
