"""A batch from the list to the ledger, on a real server with real workers."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.batch.conftest import Server
from tests.batch.driver import Batch

Workers = Callable[[int], subprocess.Popen[Any]]


def test_every_video_is_worked_on_once(server: Server, workers: Workers, tmp_path: Path) -> None:
    batch = Batch(tmp_path, {"one": {}, "two": {}})
    workers(2)
    batch.submit()
    batch.wait_ended()
    assert batch.states() == {"done": 2}
    assert all(set(toy.count("made").values()) == {1} for toy in batch.toys.values())
