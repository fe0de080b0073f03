"""A stage small enough to commit hundreds of times."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from storage_schema.artifacts import Array, Blob
from storage_schema.attempt import Attempt
from storage_schema.keys import stage_key
from storage_schema.manifest import Manifest
from storage_schema.store import ArtifactStore

ARTIFACTS = {
    "toy": (Blob("points.npz", {"x": Array("float32", ("T", 3))}), Blob("note.json"), Blob("extra.bin", optional=True)),
    "other": (Blob("note.json"),),
}
CONFIG = {"size": 0.1}
KEY = stage_key("toy", 1, CONFIG, {}, {})


def open_store(url: str | Path, cache: Path | None = None) -> ArtifactStore:
    return ArtifactStore(url, cache_dir=cache, artifacts=ARTIFACTS)


def write(folder: Path, value: float = 1.0) -> None:
    np.savez(folder / "points.npz", x=np.full((5, 3), value, np.float32))
    (folder / "note.json").write_text('{"note": "toy"}')


@contextmanager
def written(store: ArtifactStore, value: float = 1.0, key: str = KEY) -> Iterator[Attempt]:
    with store.attempt(key, "toy") as attempt:
        write(attempt.dir, value)
        yield attempt


def publish(attempt: Attempt) -> Manifest:
    roles = {"body": {"name": "packaged", "licence": "CC0-1.0", "sha256": "0" * 64}}
    return attempt.commit(stage_version=1, config=CONFIG, inputs={}, roles=roles, summary={"mean": 0.1})


def commit(store: ArtifactStore, value: float = 1.0, key: str = KEY) -> Manifest:
    with written(store, value, key) as attempt:
        return publish(attempt)


def load(store: ArtifactStore, manifest: Manifest) -> float:
    with np.load(store.fetch(manifest, "points.npz"), allow_pickle=False) as arrays:
        return float(arrays["x"][0, 0])
