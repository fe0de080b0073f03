"""`ahoy submit`, `status`, `rerun`, `cancel`, `logs`: a list of videos as a batch."""

from __future__ import annotations

import asyncio
import json
import sys
import time
from collections.abc import Callable, Coroutine, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console, Group
from rich.live import Live
from rich.markup import escape

from flows.serve.errors import NoServerError, ServerError
from flows.serve.place import connected
from storage_schema.errors import ArtifactError, StoreError

if TYPE_CHECKING:
    from flows.batch.queue import Queue
    from flows.feed_batch import FeedRequest
    from storage_schema.status import BatchStatus
    from storage_schema.store import ArtifactStore

console = Console()

EXIT_BAD_INPUT, EXIT_NO_SERVER = 2, 4
WATCH_S = 5.0

Store = Annotated[str, typer.Option("--store", envvar="AHOY_STORE", show_envvar=True, help="URL of the artifact store")]
BatchName = Annotated[str, typer.Argument(metavar="BATCH", help="name of the batch")]
Videos = Annotated[list[str] | None, typer.Option("--video", help="only this video's id; may be repeated")]


def submit(
    list_: Annotated[str, typer.Argument(metavar="LIST", help="text, CSV or Parquet file; - for standard input")],
    store: Store,
    batch: Annotated[str | None, typer.Option(help="name  [default: made of the list's content]")] = None,
    preset: Annotated[str, typer.Option(help="draft, standard or high: how much time to spend")] = "standard",
    subject: Annotated[int | None, typer.Option(help="which person, 0 for the most visible")] = None,
    stages: Annotated[str | None, typer.Option(help="only these, comma-separated, and what they need")] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", help="a knob, as STAGE.KNOB=VALUE; may be repeated")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="folder for avatars, videos and reports, beside the store")] = None,
    outstanding: Annotated[int, typer.Option(min=1, help="runs in the queue at a time")] = 100,
    tries: Annotated[int, typer.Option(min=1, help="how often a video is started if its process crashes")] = 3,
    poll: Annotated[float, typer.Option(help="seconds between the feeder's looks at the runs", hidden=True)] = 2.0,
) -> None:
    """Submit a list of videos; what is submitted is worked on whatever becomes of this command."""
    with _errors():
        from flows.batch.submission import batch_manifest
        from flows.feed_batch import FeedRequest
        from storage_schema.batches import submit as submit_manifest

        entries = _read_list(list_)
        defaults = _defaults(preset, subject, stages, set_, out)
        opened = _open(store)
        manifest, new = submit_manifest(opened, batch_manifest(list_, entries, defaults, batch))
        name = manifest.batch
        said = f"batch {name}: {len(manifest.entries)} videos"
        console.print(said if new else f"{said}, submitted before", soft_wrap=True, highlight=False)
        if not new and _nothing_to_do(opened, name):
            return
        request = FeedRequest(store=opened.url, batch=name, outstanding=outstanding, tries=tries, poll_s=poll)
        try:
            _feed(request)
        except NoServerError as error:
            raise NoServerError(f"{error}. The batch is recorded: the same command goes on from here") from None


def status(
    batch: BatchName,
    store: Store,
    as_json: Annotated[bool, typer.Option("--json", help="for programs, with every video")] = False,
    watch: Annotated[bool, typer.Option("--watch", help=f"again every {WATCH_S:.0f} s until all have ended")] = False,
) -> None:
    """Show how a batch stands, by the store alone: per stage and state, errors, time left, cost."""
    # Nothing else: importing the stages themselves would take ten seconds.
    from storage_schema.artifacts import RUN_STAGES
    from storage_schema.status import batch_status
    from storage_schema.tables import Tables

    with _errors():
        opened = _open(store)
        tables, names = Tables(opened), RUN_STAGES
        now = batch_status(opened, tables, batch, names)
        if as_json:
            sys.stdout.write(json.dumps(now.to_json(records=True), indent=1) + "\n")
            return
        if not watch:
            console.print(_shown(now))
            return
        with Live(_shown(now), console=console, auto_refresh=False) as live:
            while now.videos["waiting"] or now.videos["running"]:
                time.sleep(WATCH_S)
                now = batch_status(opened, tables, batch, names)
                live.update(_shown(now), refresh=True)


def rerun(
    batch: BatchName,
    store: Store,
    failed: Annotated[bool, typer.Option("--failed", help="only failed ones, not crashed or cancelled")] = False,
    stage: Annotated[str | None, typer.Option(help="only what ended at this stage")] = None,
    error: Annotated[str | None, typer.Option(help="only what ended with this class of error")] = None,
    videos: Videos = None,
    outstanding: Annotated[int, typer.Option(min=1, help="runs in the queue at a time")] = 100,
    tries: Annotated[int, typer.Option(min=1, help="how often a video is started if its process crashes")] = 3,
    poll: Annotated[float, typer.Option(hidden=True)] = 2.0,
) -> None:
    """Run again what failed, crashed or was cancelled; stages that were finished are found in the store."""
    with _errors():
        from flows.batch.feeder import Feeder
        from flows.feed_batch import FeedRequest

        opened = _open(store)
        request = FeedRequest(
            store=opened.url, batch=batch, rerun="failed" if failed else "unfinished", stage=stage, error=error,
            videos=tuple(videos or ()), outstanding=outstanding, tries=tries, poll_s=poll,
        )  # fmt: skip

        async def count(queue: Queue) -> int:
            feeder = Feeder.quiet(opened, queue)
            await feeder.reconcile()
            return len(request.chosen(feeder.status()))

        number = _with_queue(opened, batch, count)
        if not number:
            console.print(f"batch {batch}: nothing to run again")
            return
        console.print(f"batch {batch}: {number} videos run again")
        _feed(request)


def cancel(batch: BatchName, store: Store, reason: Annotated[str, typer.Option(help="for the record")] = "") -> None:
    """Stop a batch: nothing of it is started any more, and what is at work is stopped; `ahoy rerun` goes on with it."""
    with _errors():
        from flows.serve.install import FEED_BATCH, PROCESS_VIDEO
        from storage_schema.batches import cancel_batch

        opened = _open(store)
        first = cancel_batch(opened, batch, reason)
        console.print(f"batch {batch} is cancelled" + ("" if first else " already"))

        async def stop(queue: Queue) -> int:
            runs = [run for flow in (FEED_BATCH, PROCESS_VIDEO) async for run in queue.runs(flow, live=True)]
            await queue.cancel(runs)
            return len(runs)

        console.print(f"{_with_queue(opened, batch, stop)} runs told to stop")


def logs(batch: BatchName, store: Store, videos: Videos = None) -> None:
    """Print what the runs of a batch logged, run by run."""
    with _errors():
        from flows.batch.logs import batch_logs

        opened = _open(store)

        async def show(queue: Queue) -> None:
            async for line in batch_logs(queue, set(videos or ())):
                console.print(line, markup=False, highlight=False, soft_wrap=True)

        _with_queue(opened, batch, show)


def _read_list(source: str) -> Any:
    from flows.lists import read_list
    from tasks.errors import ListError
    from tasks.sources import policy_from_environment

    found = read_list(source, policy_from_environment())
    for problem in found.problems:
        text = f"line {problem.line}: {problem.text}: {problem.reason}"
        console.print("[yellow]left out:[/]", escape(text), highlight=False, soft_wrap=True)
    if not found.entries:
        raise ListError("no video of the list can be used; correct the lines above")
    return found.entries


def _defaults(
    preset: str, subject: int | None, stages: str | None, knobs: list[str] | None, out: Path | None
) -> dict[str, Any]:
    """What holds for every video, checked once: a knob that does not exist would fail them all."""
    from flows.request import VideoRequest

    given = {
        "preset": preset,
        "subject": subject,
        "stages": tuple(stages.split(",")) if stages else None,
        "overrides": tuple(knobs or ()),
        "out": str(out.expanduser().absolute()) if out else None,
    }
    request = VideoRequest.model_validate({**given, "video": "x", "store": "x"})
    request.settings()
    return request.model_dump(mode="json", include=set(given), exclude_defaults=True) | {"preset": preset}


def _open(store: str) -> ArtifactStore:
    """The store by an address that means the same to every worker."""
    from storage_schema.store import ArtifactStore

    return ArtifactStore(store if "://" in store else Path(store).expanduser().absolute(), workers=2)


def _nothing_to_do(store: ArtifactStore, batch: str) -> bool:
    from storage_schema.status import batch_status
    from storage_schema.tables import Tables

    now = batch_status(store, Tables(store), batch)
    if now.cancelled:
        console.print(f"it is cancelled; `ahoy rerun {batch}` goes on with it", soft_wrap=True)
        return True
    left = now.videos["waiting"] + now.videos["running"] + now.videos["crashed"]
    if left == 0:
        bad = now.videos["failed"]
        more = f"; `ahoy rerun {batch} --failed` tries the {bad} that failed again" if bad else ""
        console.print(f"it is finished: nothing to do{more}", soft_wrap=True, highlight=False)
    return left == 0


def _feed(request: FeedRequest) -> None:
    from flows.batch.submission import start_feeder

    async def start(queue: Queue) -> tuple[str, bool]:
        return await start_feeder(queue, request)

    opened = _open(request.store)
    run, started = _with_queue(opened, request.batch, start)
    console.print(
        f"feeding it is run {run}" if started else f"run {run} is feeding it already", soft_wrap=True, highlight=False
    )
    console.print(
        f"watch it with `ahoy status {request.batch} --watch --store {opened.url}`", soft_wrap=True, highlight=False
    )


def _with_queue(store: ArtifactStore, batch: str, work: Callable[[Queue], Coroutine[Any, Any, Any]]) -> Any:
    """Run something with the batch's queue in the server that answers."""

    async def run() -> Any:
        from prefect.client.orchestration import get_client
        from prefect.exceptions import ObjectNotFound

        from flows.batch.queue import Queue

        async with get_client() as client:
            try:
                return await work(Queue(client, store.url, batch))
            except ObjectNotFound as error:
                raise ServerError("nothing of Ahoy's is installed in this server; run `ahoy install`") from error

    with connected():
        return asyncio.run(run())


def _shown(now: BatchStatus) -> Group:
    from flows.batch.status_view import status_view

    return status_view(now)


@contextmanager
def _errors() -> Iterator[None]:
    """Say what is wrong in a line, without a traceback."""
    try:
        yield
    except ServerError as error:
        _fail(str(error), EXIT_NO_SERVER)
    except (ValueError, KeyError, OSError, StoreError, ArtifactError) as error:
        _fail(str(error), EXIT_BAD_INPUT)


def _fail(message: str, code: int) -> None:
    console.print("[red]error:[/]", escape(message), highlight=False, soft_wrap=True)
    raise typer.Exit(code)
