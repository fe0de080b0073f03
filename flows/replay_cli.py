"""`ahoy replay`: one stage of an earlier run again, alone, compared with what it gave then."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from flows.bad_input import bad_input_said

if TYPE_CHECKING:
    from storage_schema.store import ArtifactStore
    from tasks.replaying import Replay

console = Console()
EXIT_DIFFERENT = 1


@dataclass(frozen=True)
class Made:
    """Where the ledger says that a stage's output is, whose it is, and what its run left out and why."""

    key: str
    run_id: str
    video_id: str
    skipped: Mapping[str, str]


def replay(
    run: Annotated[str, typer.Argument(help="a folder that `ahoy run` made, or the id of a run or a video in --store")],
    stage: Annotated[str, typer.Argument(help="name of the stage; of a mapped one NAME/ITEM")],
    store: Annotated[str | None, typer.Option(help="URL of the artifact store  [default: beside the folder]")] = None,
    out: Annotated[Path | None, typer.Option(help="keep the output in this folder, which must not exist")] = None,
    video: Annotated[str | None, typer.Option(help="the video, for the stage that reads it")] = None,
    body: Annotated[str, typer.Option(help="body of the run")] = "packaged",
    prior: Annotated[str, typer.Option(help="prior of the run")] = "packaged",
    roles: Annotated[Path | None, typer.Option(help="roles.yaml of the run  [default: AHOY_ROLES]")] = None,
) -> None:
    """Run one stage again on its saved inputs; exit status 1 if the output is another."""
    from flows import models_cli
    from storage_schema.errors import StoreError

    with bad_input_said(console, StoreError):
        models_cli.choose_roles(roles, [], False)
        folder = Path(run)
        url = store or str(folder.parent / "store")
        if out is not None and out.exists():
            raise ValueError(f"expected --out to name a folder that is not there yet, got {out}")
        with tempfile.TemporaryDirectory(prefix="ahoy-replay-") as scratch:
            target = out or Path(scratch) / "out"
            target.mkdir(parents=True)
            done = _replayed(_open(url), run if store else folder.name, stage, target, (video, body, prior))
            _show(done)
        if out is not None:
            console.print(f"kept in {out}", soft_wrap=True, highlight=False)
    if not done.same:
        raise typer.Exit(EXIT_DIFFERENT)


def _open(url: str) -> ArtifactStore:
    from storage_schema.store import ArtifactStore

    if "://" not in url and not Path(url).is_dir():
        raise ValueError(f"expected a store at {url}, got none; name it with --store")
    return ArtifactStore(url)


def _replayed(store: ArtifactStore, name: str, title: str, out: Path, given: tuple[str | None, str, str]) -> Replay:
    from storage_schema.tables import Tables
    from tasks.fills import fills_from_environment
    from tasks.replaying import replay as replay_stage
    from tasks.sources import fetch_source, policy_from_environment
    from tasks.stage import Run
    from tasks.stages import STAGES

    video, body, prior = given
    known = {one.name: one for one in STAGES}
    stage = known.get(title.partition("/")[0])
    if stage is None:
        raise ValueError(f"expected a stage among {', '.join(known)}, got {title!r}")
    found = find_made(Tables(store).read("stages").to_pylist(), name, title)
    manifest = store.lookup(found.key, stage=stage.name)
    if manifest is None:
        raise FileNotFoundError(f"expected the output of {title} whole in the store, got none; run it again")
    from flows.request import source_cache
    from flows.terminal import TerminalObserver

    fills = fills_from_environment()
    source = fetch_source(video, policy_from_environment(), source_cache()) if video else None
    with TerminalObserver(console) as observer:
        observer.started(title)
        who = (found.video_id, found.run_id, observer, fills.body(body))
        run = Run(store, Tables(store), "replay", *who, prior=prior, fills=fills)

        def progress(done: int, total: int, note: str = "") -> None:
            observer.progress(title, done, total, note)

        return replay_stage(stage, manifest, run, out, progress, source, found.skipped)


def find_made(rows: list[dict[str, Any]], name: str, title: str) -> Made:
    """The latest output of a stage in a run.

    Args:
        rows: of the ledger's stages.
        name: id of a run or of a video; of a video its latest run that has the stage.
        title: the stage's name, and of a mapped one the item.

    Raises:
        ValueError: there is no such run, or it never had the stage.
    """
    mine = [row for row in rows if name in (row["run_id"], row["video_id"])]
    if not mine:
        there = ", ".join(sorted({row["video_id"] for row in rows})) or "nothing"
        raise ValueError(f"expected a run or a video of the store, got {name!r}; the store has {there}")
    stage, _, item = title.partition("/")
    made = [row for row in mine if row["stage"] == stage and row["key"] and row["state"] in ("done", "cached")]
    made = [row for row in made if json.loads(row["knobs"] or "{}").get("item", "") == item]
    if not made:
        states = sorted({f"{row['stage']} ({row['state']})" for row in mine})
        raise ValueError(f"expected {title} in {name}, got {', '.join(states)}")
    last = max(made, key=lambda row: (row["started_at"], row["seq"]))
    skipped = {row["stage"]: row["reason"] for row in rows if row["run_id"] == last["run_id"] and row["reason"]}
    return Made(last["key"], last["run_id"], last["video_id"], skipped)


def _show(done: Replay) -> None:
    table = Table("file", "compared with the stored one")
    for one in done.files:
        table.add_row(escape(one.name), escape(one.said), style=None if one.same else "bold")
    console.print(table)
    then = done.stored.summary.get("bill", {})
    now = done.bill
    console.print(
        f"{done.stored.stage} {done.stored.key[:12]}: {now.cpu_s:.1f} s CPU now, {then.get('cpu_s', 0):.1f} then; "
        f"{now.peak_rss_mb:.0f} MB now, {then.get('peak_rss_mb', 0):.0f} then",
        highlight=False,
        soft_wrap=True,
    )
    for line in done.changed:
        console.print(f"not as it was: {escape(line)}", highlight=False, soft_wrap=True)
