"""The store gives back what was committed, or says that it has to be made again."""

from __future__ import annotations

import json
import logging
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from fsspec import register_implementation
from fsspec.implementations.memory import MemoryFileSystem

from storage_schema.errors import ArtifactError, CorruptError, StoreError, StoreVersionError
from storage_schema.manifest import SCHEMA_VERSION, BlobRef, Manifest, content_hash
from storage_schema.store import ArtifactStore

from .toy import ARTIFACTS, CONFIG, KEY, commit, load, open_store, publish, write, written


def manifests(store: ArtifactStore, key: str = KEY) -> list[str]:
    return [path.rsplit("/", 1)[1] for path in store.backend.files("artifacts") if "manifest" in path and key in path]


def test_what_was_committed_is_found_by_anybody_who_opens_the_store(store: ArtifactStore, tmp_path: Path) -> None:
    assert store.lookup(KEY) is None
    manifest = commit(store, 7.0)
    again = open_store(store.url, tmp_path / "another-cache")
    found = again.lookup(KEY)
    assert found == manifest
    assert load(again, found) == 7.0
    assert {path.name for path in again.fetch(found).iterdir()} == {"points.npz", "note.json"}
    assert found.roles["body"]["licence"] == "CC0-1.0" and found.summary == {"mean": 0.1} and found.config == CONFIG


def test_a_commit_leaves_nothing_but_the_manifest_and_its_blobs(store: ArtifactStore) -> None:
    manifest = commit(store)
    expected = {blob.path for blob in manifest.blobs}
    assert {path for path in store.backend.files("") if "manifest.0001.json" not in path} == expected
    assert all(path.startswith(f"artifacts/toy/{KEY}/attempts/") for path in expected)
    assert manifests(store) == ["manifest.0001.json"]


def test_identical_outputs_have_the_same_content_hash_and_others_do_not(store: ArtifactStore) -> None:
    keys = [f"{n}" * 64 for n in range(3)]
    same, also, other = (commit(store, value, key) for value, key in zip((1.0, 1.0, 2.0), keys, strict=True))
    assert same.content_hash == also.content_hash != other.content_hash
    renamed = [replace(blob, name="x" + blob.name) for blob in same.blobs]
    assert content_hash(renamed) != same.content_hash == content_hash(reversed(same.blobs))


DAMAGE: dict[str, Callable[[bytes], bytes | None]] = {
    "deleted": lambda data: None,
    "truncated": lambda data: data[: len(data) - 2],
    "emptied": lambda data: b"",
    "bit-flipped": lambda data: data[:20] + bytes([data[20] ^ 1]) + data[21:],
}


@pytest.mark.parametrize("damage", DAMAGE)
@pytest.mark.parametrize("what", ["blob", "manifest"])
def test_a_damaged_artifact_is_not_found_and_the_next_commit_repairs_it(
    store: ArtifactStore, what: str, damage: str, caplog: pytest.LogCaptureFixture
) -> None:
    first = commit(store, 1.0)
    path = first.blob("points.npz").path if what == "blob" else f"artifacts/toy/{KEY}/manifest.0001.json"
    spoilt = DAMAGE[damage](store.backend.read(path))
    store.backend.remove(path)
    if spoilt is not None:
        store.backend.write(path, spoilt)
    with caplog.at_level(logging.WARNING):
        assert store.lookup(KEY) is None
    assert (what, damage) == ("manifest", "deleted") or "does not count" in caplog.text
    second = commit(store, 2.0)
    assert second.attempt != first.attempt
    assert store.lookup(KEY) == second
    assert load(store, second) == 2.0


def test_a_repaired_artifact_can_be_damaged_and_repaired_again(store: ArtifactStore) -> None:
    for value in range(1, 5):
        manifest = commit(store, float(value))
        assert load(store, store.lookup(KEY) or manifest) == value
        assert len(manifests(store)) == value
        store.backend.remove(manifest.blobs[0].path)
        assert store.lookup(KEY) is None


def test_an_older_manifest_counts_again_when_the_newest_is_damaged_and_it_is_whole(store: ArtifactStore) -> None:
    first = commit(store, 1.0)
    path = first.blob("note.json").path
    note = store.backend.read(path)
    store.backend.remove(path)
    second = commit(store, 2.0)
    store.backend.write(path, note)
    assert store.lookup(KEY) == second
    store.backend.remove(second.blob("note.json").path)
    assert store.lookup(KEY) == first == commit(store, 3.0)


@pytest.mark.parametrize("damage", ["deleted", "truncated"])
def test_without_verification_sizes_still_count(store: ArtifactStore, damage: str) -> None:
    path = commit(store).blob("points.npz").path
    spoilt = DAMAGE[damage](store.backend.read(path))
    store.backend.remove(path)
    if spoilt is not None:
        store.backend.write(path, spoilt)
    assert store.lookup(KEY, verify=False) is None


def test_the_second_to_commit_a_key_gets_what_the_first_committed(store: ArtifactStore) -> None:
    with written(store, 1.0) as fast, written(store, 2.0) as slow:
        winner = publish(fast)
        assert publish(slow) == winner
    assert load(store, winner) == 1.0
    assert {path for path in store.backend.files("") if "attempts" in path} == {blob.path for blob in winner.blobs}


def test_leaving_without_a_commit_leaves_nothing(store: ArtifactStore, tmp_path: Path) -> None:
    with written(store) as attempt:
        pass
    with pytest.raises(KeyboardInterrupt), written(store):
        raise KeyboardInterrupt
    assert not attempt.dir.exists() and store.backend.files("") == [] and store.lookup(KEY) is None
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def test_an_attempt_can_be_committed_once(store: ArtifactStore) -> None:
    with written(store) as attempt:
        publish(attempt)
        with pytest.raises(StoreError, match="is over"):
            publish(attempt)
    attempt.abandon()
    assert store.lookup(KEY) is not None


def test_a_refused_commit_publishes_nothing_and_can_be_put_right(store: ArtifactStore) -> None:
    with written(store) as attempt:
        (attempt.dir / "surprise").write_text("x")
        with pytest.raises(ArtifactError, match="surprise"):
            publish(attempt)
        (attempt.dir / "surprise").unlink()
        with pytest.raises(ValueError, match=r"summary\.psnr.*finite"):
            attempt.commit(stage_version=1, config={}, inputs={}, summary={"psnr": float("inf")})
        assert store.lookup(KEY) is None
        publish(attempt)
    assert store.lookup(KEY) is not None


def test_secrets_in_a_summary_do_not_reach_the_manifest(store: ArtifactStore) -> None:
    with written(store) as attempt:
        source = "https://me:hunter2@host/v.mp4?v=1&sig=hunter2"
        manifest = attempt.commit(stage_version=1, config=CONFIG, inputs={}, summary={"source": source})
    assert "hunter2" not in manifest.to_json().decode() and "host/v.mp4?v=1" in manifest.summary["source"]
    assert store.lookup(KEY) == manifest


@pytest.mark.parametrize("key", ["", "..", "a/b", "/abs", "a\\b", ".hidden", "a\0b", "x" * 200, "é"])
def test_keys_that_could_leave_their_folder_are_refused(store: ArtifactStore, key: str) -> None:
    for use in (store.lookup, lambda key: store.attempt(key, "toy"), lambda key: store.lease(key, "me", 1.0)):
        with pytest.raises(ArtifactError, match="key: expected"):
            use(key)


def test_a_stage_that_is_not_declared_cannot_be_attempted(store: ArtifactStore) -> None:
    with pytest.raises(ArtifactError, match="declares no files"):
        store.attempt(KEY, "unknown")
    with pytest.raises(ValueError, match="stage"):
        store.attempt(KEY, "../toy")


def test_a_manifest_of_a_newer_version_is_refused_and_not_overwritten(store: ArtifactStore) -> None:
    newer = replace(commit(store), schema_version=SCHEMA_VERSION + 1)
    store.backend.write(f"artifacts/toy/{KEY}/manifest.0001.json", newer.to_json())
    for use in (lambda: store.lookup(KEY), lambda: commit(store), lambda: store.gc(0)):
        with pytest.raises(StoreVersionError, match="install that version"):
            use()
    assert manifests(store) == ["manifest.0001.json"]


def test_a_manifest_under_the_wrong_key_does_not_count(store: ArtifactStore) -> None:
    commit(store)
    other = "f" * 64
    store.backend.write(
        f"artifacts/toy/{other}/manifest.0001.json", store.backend.read(f"artifacts/toy/{KEY}/manifest.0001.json")
    )
    assert store.lookup(other) is None


def test_manifests_survive_json_unchanged_and_stay_readable() -> None:
    blobs = (BlobRef("a.npz", "artifacts/toy/k/attempts/t/a.npz", 3, "0" * 64),)
    manifest = Manifest(
        schema_version=SCHEMA_VERSION,
        key="k",
        stage="toy",
        stage_version=2,
        attempt="t",
        created_at="2026-01-01T00:00:00+00:00",
        config={"x": 0.1 + 0.2, "ü": None},
        inputs={"video": "1" * 64},
        roles={"body": {"name": "p"}},
        summary={"n": 10**20},
        blobs=blobs,
        content_hash=content_hash(blobs),
    )
    assert Manifest.from_json(manifest.to_json()) == manifest
    assert json.loads(manifest.to_json())["manifest"]["config"]["ü"] is None


def test_any_changed_character_of_a_manifest_is_noticed(disk_store: ArtifactStore) -> None:
    manifest = commit(disk_store)
    data = manifest.to_json()
    for position in range(0, len(data), 7):
        changed = data[:position] + bytes([data[position] ^ 4]) + data[position + 1 :]
        try:
            # White space between tokens carries nothing: there a change may pass, and then means the same.
            assert Manifest.from_json(changed) == manifest
        except CorruptError:
            continue


def test_a_download_is_verified_and_kept_and_made_again_when_the_copy_is_damaged(tmp_path: Path) -> None:
    store = open_store(f"memory://{tmp_path.name}", tmp_path / "cache")
    manifest = commit(store, 3.0)
    path = store.fetch(manifest, "points.npz")
    assert path.is_relative_to(tmp_path / "cache")
    stamp = path.stat().st_mtime_ns
    assert store.fetch(manifest, "points.npz").stat().st_mtime_ns == stamp
    path.write_bytes(b"x" * path.stat().st_size)
    assert load(store, manifest) == 3.0
    shutil.rmtree(tmp_path / "cache")
    store.backend.write(manifest.blob("points.npz").path, b"y" * manifest.blob("points.npz").size)
    with pytest.raises(CorruptError, match="other bytes"):
        store.fetch(manifest, "points.npz")
    assert not [file for file in (tmp_path / "cache").rglob("*") if file.is_file()]


def test_fetching_what_is_gone_or_never_was_says_so(store: ArtifactStore, tmp_path: Path) -> None:
    manifest = commit(store)
    with pytest.raises(KeyError, match="it has"):
        store.fetch(manifest, "nothing.npz")
    store.backend.remove(manifest.blob("points.npz").path)
    with pytest.raises(FileNotFoundError):
        store.fetch(manifest)


def test_gc_takes_orphans_and_superseded_blobs_and_nothing_else(store: ArtifactStore) -> None:
    damaged = commit(store, 1.0)
    store.backend.remove(damaged.blob("note.json").path)
    kept = commit(store, 2.0)
    orphan = f"artifacts/toy/{KEY}/attempts/killed/points.npz"
    store.backend.write(orphan, b"half")
    assert store.gc(older_than_s=3600) == []
    removed = store.gc(older_than_s=-1)
    assert removed == sorted(
        [f"artifacts/toy/{KEY}/attempts/killed", store.attempt_folder("toy", KEY, damaged.attempt)]
    )
    assert store.lookup(KEY) == kept
    assert store.gc(older_than_s=-1) == []


def test_gc_takes_the_scratch_folder_of_a_killed_worker(disk_store: ArtifactStore) -> None:
    attempt = disk_store.attempt(KEY, "toy")
    write(attempt.dir)
    assert disk_store.gc(older_than_s=3600) == []
    for path in [attempt.dir, *attempt.dir.iterdir()]:
        os.utime(path, (1, 1))
    assert disk_store.gc(older_than_s=3600) == [f"scratch/{attempt.name}"]
    assert not attempt.dir.exists()


class Careless(MemoryFileSystem):
    """A file system that takes mode="create" for a plain write, as many do."""

    protocol = "careless"

    def pipe_file(self, path: str, value: bytes, mode: str = "overwrite", **kwargs: object) -> None:
        super().pipe_file(path, value, mode="overwrite")


register_implementation("careless", Careless, clobber=True)


@pytest.mark.parametrize("url", ["store", "memory://{}", "careless://{}"])
def test_creating_what_is_there_says_so_and_changes_nothing(
    url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    backend = open_store(url.format(tmp_path.name), tmp_path / "cache").backend
    assert backend.create("folder/file", b"first")
    assert not backend.create("folder/file", b"second")
    assert backend.read("folder/file") == b"first"
    assert backend.files("") == ["folder/file"]


@pytest.mark.parametrize(("url", "why"), [("careless://x", "only if it is absent"), ("memory://x", "one process")])
def test_several_workers_are_refused_where_two_could_commit(url: str, why: str) -> None:
    with pytest.raises(StoreError, match=why):
        ArtifactStore(url, workers=2, artifacts=ARTIFACTS)


def test_one_worker_can_use_a_file_system_without_create_if_absent(tmp_path: Path) -> None:
    store = open_store(f"careless://{tmp_path.name}", tmp_path)
    with written(store, 1.0) as one, written(store, 2.0) as other:
        assert publish(one) == publish(other)


def test_a_path_that_is_a_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "clip.mp4").touch()
    with pytest.raises(StoreError, match="is a file, expected a folder"):
        open_store(tmp_path / "clip.mp4")


def test_a_plain_path_and_a_file_url_are_the_same_store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    manifest = commit(open_store((tmp_path / "s").as_uri()))
    monkeypatch.chdir(tmp_path)
    store = ArtifactStore("s", workers=8, artifacts=ARTIFACTS)
    assert store.lookup(KEY) == manifest
    assert store.fetch(manifest, "note.json").is_absolute()
