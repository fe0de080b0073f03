"""A video, a server that offers it, and a policy under which the loopback interface may be asked."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tasks.sources import SourcePolicy
from tests.ingest.clips import encode, moving

from .server import Served, serving


@pytest.fixture(scope="session")
def clip(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A small mp4, larger than one network block."""
    path = tmp_path_factory.mktemp("clip") / "clip.mp4"
    return encode(path, moving(25, 120, 160), options={"crf": "2"}, muxer={"movflags": "+faststart"}).read_bytes()


@pytest.fixture
def server() -> Iterator[Served]:
    with serving() as served:
        yield served


@pytest.fixture
def policy() -> SourcePolicy:
    return SourcePolicy(
        private_hosts=("127.0.0.1",), attempts=3, backoff_s=0.001, connect_timeout_s=20.0, read_timeout_s=20.0
    )


@pytest.fixture
def cache(tmp_path: Path) -> Path:
    return tmp_path / "cache"
