"""`ahoy plan`: time and cost of N videos on M workers, simulated from the ledger."""

from __future__ import annotations

import json
import re
from datetime import timedelta
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

if TYPE_CHECKING:
    from ahoy_core.cost.plan import Estimate, Plan
    from ahoy_core.cost.simulate import Fleet, MeasuredVideo

console = Console()

EXIT_BAD_INPUT = 2
_SLOT = re.compile(r"([a-z][a-z0-9_-]*)=(\d+):([a-z0-9_]+(?:,[a-z0-9_]+)*)")


def plan(
    store: Annotated[str, typer.Option(help="folder or URL of the store whose ledger was measured")],
    videos: Annotated[int, typer.Option(min=1, help="how many videos")],
    workers: Annotated[int, typer.Option(min=1, help="videos side by side, over all machines")] = 1,
    slot: Annotated[
        list[str] | None,
        typer.Option(help="a limited resource and the stages that hold it, as gpu=1:coarse,animate; may be repeated"),
    ] = None,
    per_machine: Annotated[int, typer.Option(min=1, help="workers on one machine")] = 1,
    price: Annotated[float, typer.Option(min=0, help="of one machine for an hour, in any currency")] = 0.0,
    batch: Annotated[list[str] | None, typer.Option(help="measured batches to plan from  [default: all]")] = None,
    repeats: Annotated[
        int | None, typer.Option(min=2, help="simulated batches  [default: as many as are cheap]")
    ] = None,
    seed: Annotated[int, typer.Option(help="of the draws")] = 0,
    as_json: Annotated[bool, typer.Option("--json", help="print JSON")] = False,
) -> None:
    """Say how long a batch would take, what it would cost, where it would queue, and what one more of each buys."""
    from ahoy_core.cost.plan import plan as make_plan
    from storage_schema.errors import StoreError
    from storage_schema.store import ArtifactStore
    from tasks.ledger import read_measured

    try:
        fleet = _fleet(workers, slot or [], per_machine, price)
        with console.status("reading the ledger"):
            measured = read_measured(ArtifactStore(store), batch or [])
        _check_stages(fleet, measured)
        with console.status(f"simulating {videos:,} videos"):
            made = make_plan(measured, fleet, videos, repeats=repeats, seed=seed)
    except (StoreError, ValueError, OSError) as error:
        console.print("[red]error:[/]", escape(str(error)), highlight=False, soft_wrap=True)
        raise typer.Exit(EXIT_BAD_INPUT) from None
    if as_json:
        print(json.dumps({"measured_videos": len(measured), **made.to_json()}))
    else:
        _show(made, fleet, len(measured))


def _fleet(workers: int, slots: list[str], per_machine: int, price: float) -> Fleet:
    from ahoy_core.cost.simulate import Fleet

    counts: dict[str, int] = {}
    needs: dict[str, str] = {}
    for text in slots:
        match = _SLOT.fullmatch(text)
        if match is None:
            raise ValueError(f"--slot: expected NAME=COUNT:STAGE,STAGE such as gpu=1:coarse,animate, got {text!r}")
        name, count, stages = match.groups()
        counts[name] = int(count)
        for stage in stages.split(","):
            if needs.setdefault(stage, name) != name:
                raise ValueError(f"--slot: stage {stage} is given to {needs[stage]} and {name}; a stage holds one")
    return Fleet(workers, counts, needs, per_machine, price)


def _check_stages(fleet: Fleet, measured: list[MeasuredVideo]) -> None:
    known = {stage for video in measured for attempt in video.attempts for stage, _ in attempt.steps}
    if measured and (unknown := sorted(set(fleet.needs) - known)):
        raise ValueError(f"--slot: stages {unknown} were never measured; the ledger has {sorted(known)}")


def _show(made: Plan, fleet: Fleet, measured: int) -> None:
    console.print(
        f"{made.videos:,} videos on {fleet.workers} workers ({fleet.machines} machines), from {measured} measured "
        f"videos and {made.repeats} simulated batches (intervals hold nine tenths of them)",
        soft_wrap=True,
    )
    console.print(f"time   {_span(made.makespan_s)}")
    if fleet.price_per_hour:
        console.print(f"cost   {made.cost.median:.2f}  ({made.cost.low:.2f} to {made.cost.high:.2f})")
    console.print(f"runs   {made.attempts:.1f} attempts, {made.failed:.1f} videos that fail for good")
    queue = Table("resource", "capacity", "busy", "mean wait", "mean queue")
    for name, use in made.uses.items():
        mark = "  <- bottleneck" if name == made.bottleneck else ""
        queue.add_row(name, str(use.capacity), f"{use.utilisation:.0%}{mark}", _time(use.wait_s), f"{use.waiting:.1f}")
    console.print(queue)
    buys = Table("one more", "then", "time", "saves", "cost")
    for option in made.what_if:
        price = f"{option.cost:.2f}" if fleet.price_per_hour else "-"
        row = (option.resource, str(option.capacity), _time(option.makespan_s.median), _time(option.saved_s), price)
        buys.add_row(*row)
    console.print(buys)


def _span(estimate: Estimate) -> str:
    return f"{_time(estimate.median)}  ({_time(estimate.low)} to {_time(estimate.high)})"


def _time(seconds: float) -> str:
    if abs(seconds) < 60:
        return f"{seconds:.1f} s"
    return str(timedelta(seconds=round(seconds)))
