"""A store that somebody else wrote: newer schemas are refused, unreadable manifests and hostile names not believed."""

from __future__ import annotations

import contextlib
from dataclasses import replace
from pathlib import Path

import pytest

from storage_schema.errors import StoreVersionError
from storage_schema.manifest import SCHEMA_VERSION, content_hash
from storage_schema.store import ArtifactStore
from tests.storage.toy import KEY, commit, open_store

MANIFEST = f"artifacts/toy/{KEY}/manifest.0001.json"


@pytest.fixture
def store(tmp_path: Path) -> ArtifactStore:
    return open_store(tmp_path / "store", tmp_path / "cache")


def test_a_store_of_a_newer_schema_is_refused_with_what_to_do(store: ArtifactStore) -> None:
    newer = replace(commit(store), schema_version=SCHEMA_VERSION + 1)
    store.backend.write(MANIFEST, newer.to_json())
    with pytest.raises(StoreVersionError, match="install that version"):
        store.lookup(KEY)
    assert store.backend.read(MANIFEST) == newer.to_json()


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"{",
        b"null",
        b"[]",
        b"\xff\xfe\x00",
        b'{"manifest": {}, "sha256": ""}',
        b'{"manifest": [], "sha256": "x"}',
        b"[" * 100_000,
        b'{"manifest": {"schema_version": 1e999}, "sha256": ""}',
        b"cos\nsystem\n(S'id'\ntR.",
    ],
)
def test_an_unreadable_manifest_is_none_and_the_stage_is_made_again(store: ArtifactStore, content: bytes) -> None:
    commit(store)
    store.backend.write(MANIFEST, content)
    assert store.lookup(KEY) is None
    assert commit(store) == store.lookup(KEY)


@pytest.mark.parametrize("name", ["../../stolen", "{outside}/stolen", "..\\stolen", "a/../../stolen"])
def test_a_manifest_cannot_make_a_reader_write_outside_its_folder(tmp_path: Path, name: str) -> None:
    remote = open_store(f"memory://{tmp_path.name}", tmp_path / "cache")
    manifest = commit(remote)
    first, *others = manifest.blobs
    blobs = (replace(first, name=name.format(outside=tmp_path)), *others)
    hostile = replace(manifest, blobs=blobs, content_hash=content_hash(blobs))
    remote.backend.write(MANIFEST, hostile.to_json())
    found = remote.lookup(KEY)
    if found is not None:
        with contextlib.suppress(ValueError, OSError):
            remote.fetch(found)
    assert not [path for path in tmp_path.rglob("*") if "stolen" in path.name]


@pytest.mark.parametrize("path", ["../outside", "/etc/passwd", "artifacts/../../outside", "a//b", ""])
def test_a_manifest_cannot_make_a_reader_read_outside_the_store(store: ArtifactStore, path: str) -> None:
    manifest = commit(store)
    first, *others = manifest.blobs
    store.backend.write(MANIFEST, replace(manifest, blobs=(replace(first, path=path), *others)).to_json())
    assert store.lookup(KEY) is None
