"""Rows of the table `attempts`: each try at a video says where it is and how it ends, so that the store knows."""

from __future__ import annotations

import os
import socket
import time
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

from tasks.errors import message_of
from tasks.stage import Run

SEQUENCE_STEP = 1000  # rows that one process may write: a retry of the same run goes on behind them
CRASHED_SEQUENCE = SEQUENCE_STEP - 1


@dataclass
class AttemptRows:
    """Writes the rows of one try.

    Attributes:
        run: the try.
        flow_run_id: the orchestrator's id, None without one.
    """

    run: Run
    flow_run_id: str | None = None
    _started: float = field(default_factory=time.monotonic)
    _cpu: float = field(default_factory=time.process_time)

    def at(self, stage: str) -> None:
        """Say that the try is at work on a stage: who dies without a word dies there."""
        self._append("running", stage=stage)

    def ended(self, state: str, stage: str | None = None, error: BaseException | None = None) -> None:
        """Say how it ended.

        Args:
            state: done, failed, crashed or cancelled.
            stage: where.
            error: what was raised.
        """
        message = message_of(error) if error else None
        self._append(state, stage=stage, error_class=type(error).__name__ if error else None, error_message=message)

    def _append(self, state: str, **more: Any) -> None:
        row = {
            **attempt_row(self.run.video_id, self.run.attempt_number, next(self.run.sequence), state),
            "run_id": self.run.run_id,
            "flow_run_id": self.flow_run_id,
            "worker": f"{socket.gethostname()}:{os.getpid()}",
            "wall_s": time.monotonic() - self._started,
            "cpu_s": time.process_time() - self._cpu,
        }
        self.run.tables.append("attempts", [{**row, **more}], batch=self.run.batch)


def attempt_row(video_id: str, number: int, sequence: int, state: str) -> dict[str, Any]:
    """Return the columns that every row has; whoever is not the try itself writes with these alone."""
    return {
        "video_id": video_id,
        "run_id": "",
        "attempt_number": number,
        "seq": sequence,
        "state": state,
        "at": datetime.now(UTC),
    }
