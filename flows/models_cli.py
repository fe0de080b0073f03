"""`ahoy models`: what fills each role, where the files come from, pulling and verifying them."""

from __future__ import annotations

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TransferSpeedColumn
from rich.table import Table

from tasks import model_files

app = typer.Typer(no_args_is_help=True, help="The files of the networks that fill roles: list, pull, verify.")
console = Console()

EXIT_BAD_MODEL = 3


@app.command("list")
def list_() -> None:
    """Show every model file: role, source, size, licence, and whether it is here."""
    table = Table("model", "role", "source", "size", "licence", "sha256", "state")
    for status in model_files.verify():
        model = status.model
        source = f"{model.wheel.package} {model.wheel.version}"
        size = f"{model.size / 2**20:.1f} MB"
        table.add_row(model.name, model.role, source, size, model.licence, model.sha256[:12], status.state)
    console.print(table)
    console.print(f"kept in {model_files.cache_dir()} (AHOY_MODELS chooses another folder)", soft_wrap=True)


@app.command()
def pull() -> None:
    """Fetch what is missing, once; refuse what does not match its hash."""
    columns = (TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TransferSpeedColumn())
    try:
        with Progress(*columns, console=console, disable=not console.is_terminal) as bars:
            bar = bars.add_task("models", total=None)

            def show(done: int, total: int, note: str) -> None:
                bars.update(bar, completed=done, total=total, description=note)

            paths = model_files.pull(show)
    except model_files.ModelFileError as error:
        console.print("[red]error:[/]", escape(str(error)), highlight=False, soft_wrap=True)
        raise typer.Exit(EXIT_BAD_MODEL) from None
    console.print(f"{len(paths)} model files are in {model_files.cache_dir()}", soft_wrap=True)


@app.command()
def verify() -> None:
    """Hash every model file; the exit status says whether all are as they should be."""
    bad = [status for status in model_files.verify() if status.state != "ok"]
    for status in bad:
        console.print(f"{status.model.name}: {status.state} ({status.path}); run `ahoy models pull`", soft_wrap=True)
    if bad:
        raise typer.Exit(EXIT_BAD_MODEL)
    console.print("all model files match their hashes")
