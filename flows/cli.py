"""The `ahoy` command."""

from __future__ import annotations

import logging
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from flows import (
    batch_cli,
    cost_cli,
    evaluate_cli,
    export_cli,
    models_cli,
    plan_cli,
    prior_cli,
    render_cli,
    replay_cli,
    server_cli,
    store_cli,
    view_cli,
)
from flows.bad_input import bad_input_said
from storage_schema.secrets import RedactSecrets

if TYPE_CHECKING:
    from flows.pipeline import Call
    from flows.request import VideoRequest

app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)
app.add_typer(models_cli.app, name="models")
app.add_typer(prior_cli.app, name="prior")
app.add_typer(store_cli.app, name="store")
COMMANDS = (
    *(batch_cli.submit, batch_cli.status, batch_cli.rerun, batch_cli.cancel, batch_cli.logs),
    *(plan_cli.plan, cost_cli.cost, replay_cli.replay),
    *(server_cli.server, server_cli.worker, server_cli.install),
    *(render_cli.render, export_cli.export, view_cli.view, evaluate_cli.evaluate),
)
for command in COMMANDS:
    app.command()(command)

EXIT_INTERRUPTED = 130


@app.callback()
def main(verbose: Annotated[bool, typer.Option("--verbose", "-v", help="log what happens")] = False) -> None:
    """Turn videos of half-hidden people into animatable 3D Gaussian avatars."""
    logging.basicConfig(
        level=logging.INFO if verbose else logging.WARNING, format="%(levelname)s %(name)s: %(message)s"
    )
    for handler in logging.getLogger().handlers:
        handler.addFilter(RedactSecrets())
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # spinning threads made a training step six times slower
    os.environ.setdefault("PREFECT_SERVER_ANALYTICS_ENABLED", "false")
    os.environ.setdefault("DO_NOT_TRACK", "1")


@app.command()
def run(
    video: Annotated[str, typer.Argument(help="a video: a path or an address")],
    out: Annotated[Path, typer.Option(help="folder for the avatar, the videos and the report")],
    preset: Annotated[
        str | None, typer.Option(help="draft, standard or high: how much time to spend  [default: standard]")
    ] = None,
    budget: Annotated[
        str | None, typer.Option(help="time to spend, such as 90s or 3m: the knobs that buy the most in it")
    ] = None,
    subject: Annotated[
        str | None, typer.Option(help="which person, 0 for the most visible, or all: one avatar each")
    ] = None,
    list_subjects: Annotated[
        bool, typer.Option("--list-subjects", help="only show who is in the video, on a sheet in OUT/<video>/")
    ] = False,
    stages: Annotated[str | None, typer.Option(help="only these, comma-separated, and what they need")] = None,
    store: Annotated[str | None, typer.Option(help="URL of the artifact store  [default: OUT/store]")] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", help="a knob, as STAGE.KNOB=VALUE; may be repeated")
    ] = None,
    roles: Annotated[
        Path | None, typer.Option(help="roles.yaml: which model fills each role  [default: AHOY_ROLES]")
    ] = None,
    role: Annotated[
        list[str] | None, typer.Option("--role", help="one role, as ROLE=FILL:PATH or ROLE=embedded; may be repeated")
    ] = None,
    trust_code: Annotated[
        bool, typer.Option("--trust-code", help="TorchScript files that --role names are programs and may be run")
    ] = False,
    prefect: Annotated[
        bool, typer.Option("--prefect", help="run as a Prefect flow, watched at PREFECT_API_URL")
    ] = False,
) -> None:
    """Turn one video into an avatar, here and now; what is already made is not made again."""
    from flows.request import VideoRequest

    console = Console()
    try:
        with bad_input_said(console):
            models_cli.choose_roles(roles, role or [], trust_code)
            request = VideoRequest.model_validate(
                {
                    "video": video,
                    "out": str(out),
                    "store": store,
                    "preset": preset or "standard",
                    "subject": int(subject) if subject and subject.isdigit() else subject,
                    "stages": tuple(stages.split(",")) if stages else None,
                    "overrides": tuple(set_ or ()),
                }
            )
            call: Call | None = None
            if budget is not None:
                request, call = _within(request, budget, preset, console)
            elif not list_subjects:
                console.print(_cited(request.preset), soft_wrap=True, highlight=False)
            if list_subjects:
                paths = _list_here(request, console)
            else:
                paths = _run_flow(request) if prefect else _run_here(request, console, call)
    except KeyboardInterrupt:
        console.print("interrupted; finished stages are kept, the same command goes on from there")
        raise typer.Exit(EXIT_INTERRUPTED) from None
    for name, path in paths.items():
        console.print(f"{name:<20} {path}", soft_wrap=True, highlight=False)


def _cited(preset: str) -> str:
    from tasks.cost.measured import cited, packaged_set

    return cited(preset, packaged_set())


def _within(request: VideoRequest, budget: str, preset: str | None, console: Console) -> tuple[VideoRequest, Call]:
    """The request with the knobs that a budget buys, and how to call its stages so that it is kept."""
    from flows.budget import budgeted
    from flows.duration import seconds_of

    if preset is not None:
        raise ValueError(f"expected --preset or --budget, got both ({preset}, {budget}): a budget chooses the knobs")

    def told(line: str) -> None:
        console.print(line, soft_wrap=True, highlight=False)

    chosen, call = budgeted(request, seconds_of(budget, "3m"), told=told)
    for line in chosen.said:
        told(line)
    return request.model_copy(update={"preset": chosen.preset, "overrides": chosen.overrides}), call


def _run_here(request: VideoRequest, console: Console, call: Call | None) -> dict[str, Path]:
    from flows.deliver import deliver
    from flows.pipeline import call_directly, process
    from flows.subjects import each_subject
    from flows.terminal import TerminalObserver

    settings = request.settings()
    source = request.source()
    paths: dict[str, Path] = {}
    with TerminalObserver(console) as observer:
        attempt = request.run(request.id_of(source), observer)
        for prefix, chosen, run in each_subject(request.subject, source, settings, attempt):
            # A budget is kept for one avatar; of several, each is made with the knobs of the first choice.
            steered = call if call and request.subject != "all" else call_directly
            outcome = process(source, chosen, run, only=request.stages, call=steered)
            for stage, reason in outcome.skipped.items():
                console.print(f"{stage:<10} skipped: {reason}")
            made = deliver(outcome, run, request.out) if request.out else {}
            paths |= {prefix + name: path for name, path in made.items()}
    return paths


def _list_here(request: VideoRequest, console: Console) -> dict[str, Path]:
    from flows.subjects import deliver_sheet, list_people
    from flows.terminal import TerminalObserver

    source = request.source()
    with TerminalObserver(console) as observer:
        attempt = request.run(request.id_of(source), observer)
        people = list_people(source, request.settings(), attempt)
    table = Table("subject", "frames", "first", "last", "shots", "size in pixels", "prominence")
    for row in people.subjects:
        shots, worth = ", ".join(map(str, row["shots"])), f"{row['worth']:.0%}"
        cells = (row["number"], row["frames"], row["first"], row["last"], shots, round(row["size"]), worth)
        table.add_row(*map(str, cells))
    console.print(table)
    return {"subjects.png": deliver_sheet(people, Path(request.out or ".") / attempt.video_id)}


def _run_flow(request: VideoRequest) -> dict[str, Path]:
    from flows.process_video import process_video

    made: Any = process_video(request)
    return {name: Path(path) for name, path in made.items()}
