"""`ahoy view`: an avatar in the browser."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape

EXIT_BAD_INPUT = 2


def view(
    path: Annotated[Path, typer.Argument(help="folder of an avatar, or the --out folder of `ahoy run`")],
    port: Annotated[int, typer.Option(help="port to listen on")] = 8080,
    host: Annotated[str, typer.Option(help="address to listen on; the loopback alone by default")] = "127.0.0.1",
) -> None:
    """Turn an avatar about, play motions, move its face, and see which parts were observed and where they came from."""
    from tasks.view import serve

    console = Console()
    try:
        serve(path, port, host, lambda text: console.print(text, highlight=False))
    except KeyboardInterrupt:
        return
    except (ValueError, OSError, ImportError) as error:
        console.print("[red]error:[/]", escape(str(error)), highlight=False, soft_wrap=True)
        raise typer.Exit(EXIT_BAD_INPUT) from None
