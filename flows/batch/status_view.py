"""How a batch stands, for the terminal."""

from __future__ import annotations

from rich.console import Group, RenderableType
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from storage_schema.status import BatchStatus

_COLUMNS = ("waiting", "running", "done", "cached", "skipped", "failed")


def status_view(status: BatchStatus) -> Group:
    """Return counts, stages, errors with an example, time left and cost."""
    parts: list[RenderableType] = [_headline(status), _stages(status)]
    if status.errors:
        parts.append(_errors(status))
    parts.append(Text(f"cost so far: {_duration(status.cost.cpu_s)} CPU, {_duration(status.cost.wall_s)} of stages"))
    return Group(*parts)


def _headline(status: BatchStatus) -> Text:
    counts = ", ".join(f"{count} {state}" for state, count in status.videos.items() if count)
    left = status.videos["waiting"] + status.videos["running"]
    eta = (
        ""
        if not left
        else f"; about {_duration(status.eta_s)} left"
        if status.eta_s is not None
        else "; time left not known yet"
    )
    cancelled = " (cancelled)" if status.cancelled else ""
    return Text(f"{status.batch}{cancelled}: {status.total} videos: {counts}{eta}")


def _stages(status: BatchStatus) -> Table:
    table = Table("stage", *_COLUMNS, "CPU")
    for name, counts in status.stages.items():
        cost = status.cost_by_stage.get(name)
        cells = [str(counts.get(column, 0) or "") for column in _COLUMNS]
        table.add_row(name, *cells, _duration(cost.cpu_s) if cost else "")
    return table


def _errors(status: BatchStatus) -> Table:
    table = Table("error", "videos", "stages", "for example")
    for group in status.errors:
        stages = ", ".join(f"{stage} {count}" for stage, count in group.stages.items())
        table.add_row(
            group.error_class, str(group.count), stages, escape(f"{group.example_video}: {group.example_message}")
        )
    return table


def _duration(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.0f} s"
    minutes = seconds / 60
    return f"{minutes:.0f} min" if minutes < 120 else f"{minutes / 60:.1f} h"
