"""Shows a run in the terminal: a progress bar per stage, or a line per stage where nobody is watching."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from tasks.stage import StageRef


class TerminalObserver:
    """An `Observer` that draws with rich; enter it for as long as bars should live."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._bars: dict[str, TaskID] = {}
        columns = (
            TextColumn("{task.description:<10}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("{task.fields[note]}"),
        )
        self._progress = Progress(*columns, console=console, disable=not console.is_terminal)

    def __enter__(self) -> TerminalObserver:
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._progress.stop()

    def started(self, stage: str) -> None:
        """Open the stage's bar."""
        self._bars[stage] = self._progress.add_task(stage, total=None, note="")

    def progress(self, stage: str, done: int, total: int, note: str) -> None:
        """Move the stage's bar."""
        self._progress.update(self._bars[stage], completed=done, total=total, note=note)

    def showed(self, stage: str, picture: Path) -> None:
        """Do nothing: a terminal shows no pictures."""

    def finished(self, ref: StageRef, folder: Path) -> None:
        """Close the bar and leave one line that says what the stage cost."""
        self._progress.remove_task(self._bars.pop(ref.title))
        if ref.state == "cached":
            self._console.print(f"{ref.title:<10} found in the store")
        else:
            bill = ref.bill
            self._console.print(
                f"{ref.title:<10} {bill.wall_s:6.1f} s  ({bill.cpu_s:.1f} s CPU, {bill.peak_rss_mb:.0f} MB)"
            )
