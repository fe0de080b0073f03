"""`ahoy models`: what fills each role, where the files come from, pulling and verifying them."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TransferSpeedColumn
from rich.table import Table

from ahoy_core.models.catalogue import ADAPTERS, EMBEDDED
from ahoy_core.models.errors import ModelError
from tasks import model_files

app = typer.Typer(no_args_is_help=True, help="What fills each role: list, pull, verify, roles, check.")
console = Console()

EXIT_BAD_MODEL = 3

Roles = Annotated[Path | None, typer.Option("--roles", envvar="AHOY_ROLES", help="roles.yaml of this machine")]


@app.command("list")
def list_() -> None:
    """Show every model file: role, source, size, licence, and whether it is here."""
    table = Table("model", "role", "source", "size", "licence", "sha256", "state")
    for status in model_files.verify():
        model = status.model
        size = f"{model.size / 2**20:.1f} MB"
        state = "optional" if status.left_out else status.state
        table.add_row(model.name, model.role, model.archive.label, size, model.licence, model.sha256[:12], state)
    console.print(table)
    console.print(f"kept in {model_files.cache_dir()} (AHOY_MODELS chooses another folder)", soft_wrap=True)


@app.command()
def pull(
    names: Annotated[list[str] | None, typer.Argument(help="optional models to fetch too")] = None,
) -> None:
    """Fetch what is missing, once; refuse what does not match its hash."""
    columns = (TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TransferSpeedColumn())
    try:
        with Progress(*columns, console=console, disable=not console.is_terminal) as bars:
            bar = bars.add_task("models", total=None)

            def show(done: int, total: int, note: str) -> None:
                bars.update(bar, completed=done, total=total, description=note)

            paths = model_files.pull(show, names or ())
    except model_files.ModelFileError as error:
        console.print("[red]error:[/]", escape(str(error)), highlight=False, soft_wrap=True)
        raise typer.Exit(EXIT_BAD_MODEL) from None
    console.print(f"{len(paths)} model files are in {model_files.cache_dir()}", soft_wrap=True)


@app.command()
def verify() -> None:
    """Hash every model file; the exit status says whether all are as they should be."""
    bad = [each for each in model_files.verify() if each.state != "ok" and not each.left_out]
    for status in bad:
        console.print(f"{status.model.name}: {status.state} ({status.path}); run `ahoy models pull`", soft_wrap=True)
    if bad:
        raise typer.Exit(EXIT_BAD_MODEL)
    console.print("all model files match their hashes")


@app.command()
def roles() -> None:
    """Show which models can fill each role, under which licence, and what they need."""
    table = Table("role", "fill", "model", "licence", "commercial use", "weights", "extra")
    for each in ADAPTERS:
        size = f"{each.weights_gib():.1f} GiB {each.dtype}" if each.parameters else ""
        # Escaped: "FLUX.1 Fill [dev]" would lose its last word, as the name of a style.
        words = (each.role, each.name, each.title, each.licence, each.commercial, size, each.extra or "")
        table.add_row(*map(escape, words))
    console.print(table)
    console.print(
        f"every role is filled by {EMBEDDED} unless roles.yaml says otherwise; docs/models.md", soft_wrap=True
    )


@app.command()
def check(
    what: Annotated[str, typer.Argument(metavar="ROLE=PATH", help="or ROLE=FILL:PATH, or a ROLE of roles.yaml")],
    roles: Roles = None,
    trust_code: Annotated[
        bool, typer.Option("--trust-code", help="the TorchScript file is a program and may be run")
    ] = False,
    own_weights: Annotated[
        bool, typer.Option("--own-weights", help="the weights are your own: do not compare published hashes")
    ] = False,
    device: Annotated[str, typer.Option(help="cpu, cuda, cuda:1; auto is cuda where there is one")] = "auto",
) -> None:
    """Load what is to fill a role, run one tiny input through it, and print shapes, time and memory."""
    try:
        from tasks.fills import read_fills
        from tasks.model_check import check as run_check
        from tasks.model_check import parse

        fills = read_fills(roles.read_text(encoding="utf-8")) if roles else read_fills("")
        declared, fill = parse(what, trust_code, own_weights, fills.chosen)
        found = run_check(declared, fill if device == "auto" else fill.model_copy(update={"device": device}))
    except (ModelError, OSError, ValueError) as error:
        console.print("[red]error:[/]", escape(str(error)), highlight=False, soft_wrap=True)
        raise typer.Exit(EXIT_BAD_MODEL) from None
    console.print(f"{declared.label}: {declared.title} on {found.device}", soft_wrap=True, markup=False)
    console.print(f"licence: {declared.licence} ({declared.licence_at})", soft_wrap=True, highlight=False, markup=False)
    for name, words in {**found.hashes, **found.shapes}.items():
        console.print(f"{name:<10} {words}", markup=False, highlight=False, soft_wrap=True)
    console.print(
        f"loaded in {found.load.wall_s:.2f} s ({found.load.cpu_s:.2f} CPU-s), "
        f"ran in {found.run.wall_s:.2f} s ({found.run.cpu_s:.2f} CPU-s), peak {found.memory_mib:.0f} MiB",
        soft_wrap=True,
    )


def choose_roles(file: Path | None, flags: list[str], trust_code: bool) -> None:
    """Say for this process which models fill roles: those of a file, with flags laid over them.

    Raises:
        ModelError: the file or a flag is not as it should be.
    """
    from tasks.fills import ENVIRONMENT, fills_from_environment, with_flags

    if file is not None:
        os.environ[ENVIRONMENT] = str(file)
    if flags:
        os.environ[ENVIRONMENT] = with_flags(fills_from_environment(), flags, trust_code).to_json()
