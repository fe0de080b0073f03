"""What a user does with a batch, for tests: a list of toys, the command line, and looking at the ledger."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from typer.testing import CliRunner, Result

from flows.cli import app
from storage_schema.status import BatchStatus, VideoStatus, batch_status
from storage_schema.store import ArtifactStore
from storage_schema.tables import Tables
from tests.batch.conftest import READY_S, wait_for
from tests.batch.toy import Toy


class Batch:
    """A list of toy videos in a folder, and the store beside it.

    Args:
        folder: where.
        videos: name -> what its stages do (`Toy.make`).
    """

    def __init__(self, folder: Path, videos: Mapping[str, Mapping[str, list[str]]]) -> None:
        self.list = folder / "list.txt"
        self.store = ArtifactStore(folder / "store")
        self.tables = Tables(self.store)
        self.toys = {name: Toy.make(folder, name, **does) for name, does in videos.items()}
        self.list.write_text("\n".join(str(toy.path) for toy in self.toys.values()))
        self.name = f"batch-{folder.name}"

    def submit(self, *more: str) -> Result:
        return self.ahoy("submit", str(self.list), "--batch", self.name, "--poll", "0.3", *more)

    def ahoy(self, command: str, *words: str, code: int = 0) -> Result:
        result = CliRunner().invoke(app, [command, *words, "--store", str(self.store.backend.root)])
        assert result.exit_code == code, result.output
        return result

    def status(self) -> BatchStatus:
        return batch_status(self.store, self.tables, self.name)

    def video(self, name: str) -> VideoStatus:
        return next(record for record in self.status().records if record.video_id.startswith(f"{name}-"))

    def states(self) -> dict[str, int]:
        return {state: count for state, count in self.status().videos.items() if count}

    def wait_ended(self, limit_s: float = READY_S) -> None:
        def ended() -> bool:
            return not {"waiting", "running"} & set(self.states())

        wait_for(ended, f"the end of {self.name}", limit_s)

    def rerun(self, *words: str) -> str:
        return self.ahoy("rerun", self.name, "--poll", "0.3", *words).output

    def rows(self, table: str) -> list[dict[str, Any]]:
        rows: list[dict[str, Any]] = self.tables.read(table, self.name).to_pylist()
        return rows

    def attempts(self, name: str) -> list[tuple[int, str]]:
        mine = [row for row in self.rows("attempts") if row["video_id"].startswith(f"{name}-")]
        return sorted({(row["attempt_number"], row["state"]) for row in mine})
