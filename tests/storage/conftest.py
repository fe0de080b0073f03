"""Stores to test on: a folder of this machine, and fsspec's memory for what holds on any file system."""

from __future__ import annotations

import uuid
from pathlib import Path

import pytest

from storage_schema.store import ArtifactStore
from storage_schema.tables import Tables

from .toy import open_store


@pytest.fixture(params=["file", "memory"])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> ArtifactStore:
    url = tmp_path / "store" if request.param == "file" else f"memory://{uuid.uuid4().hex}"
    return open_store(url, tmp_path / "cache")


@pytest.fixture
def disk_store(tmp_path: Path) -> ArtifactStore:
    return open_store(tmp_path / "store", tmp_path / "cache")


@pytest.fixture
def tables(store: ArtifactStore) -> Tables:
    return Tables(store)
