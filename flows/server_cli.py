"""`ahoy server`, `ahoy worker`, `ahoy install`: the batch system on this machine."""

from __future__ import annotations

import asyncio
import os
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape

from flows.serve.errors import ServerError
from flows.serve.place import (
    QUIET,
    URL,
    WORKER_SETTINGS,
    Place,
    check_answers,
    client_environment,
    connected,
    default_place,
)

console = Console()

EXIT_NO_SERVER = 4

Data = Annotated[Path | None, typer.Option("--data", help="folder of database and password  [default: AHOY_SERVER]")]
Gpus = Annotated[int, typer.Option("--gpus", min=0, help="runs that may use a GPU at a time, over all workers")]
Downloads = Annotated[int, typer.Option("--downloads", min=1, help="videos fetched at a time, over all workers")]


def server(
    data: Data = None,
    host: Annotated[str, typer.Option(help="address to listen on")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=1, max=65535, help="port to listen on")] = 4200,
    database_url: Annotated[
        str | None,
        typer.Option(
            envvar="AHOY_DATABASE_URL", show_envvar=True, help="a Postgres of your own, as postgresql+asyncpg://..."
        ),
    ] = None,
    auth: Annotated[bool, typer.Option(help="ask for the password; without it only this machine may connect")] = True,
    installs: Annotated[bool, typer.Option("--install/--no-install", help="install what Ahoy needs in it")] = True,
    gpus: Gpus = 1,
    downloads: Downloads = 4,
) -> None:
    """Start Prefect on an embedded Postgres, with all that Ahoy needs installed in it; Ctrl-C stops it."""
    from flows.serve.prefect_server import PrefectServer
    from flows.serve.supervisor import Supervisor

    if not auth and host not in ("127.0.0.1", "::1", "localhost"):
        _fail("--no-auth lets anybody who can connect run code: it works with --host 127.0.0.1 alone")
    place = _place(data)

    def ready(running: PrefectServer) -> None:
        os.environ.update(running.client())
        if installs:
            _install(place, gpus, downloads)
        console.print(f"Prefect's pages: {running.url.removesuffix('/api')}", soft_wrap=True, highlight=False)
        if auth:
            console.print(f"password: in {place.folder / 'auth'}", soft_wrap=True, highlight=False)
        console.print("next: `ahoy worker` in another terminal, then `ahoy submit LIST --store URL`; Ctrl-C stops")

    try:
        Supervisor(place, host, port, database_url, auth).run(ready)
    except ServerError as error:
        _fail(str(error))


def worker(
    limit: Annotated[int, typer.Option("--limit", "-n", min=1, help="videos at a time")] = 1,
    name: Annotated[str | None, typer.Option(help="name in Prefect's pages")] = None,
    data: Data = None,
) -> None:
    """Work on videos as they are submitted; start as many as you like, here or on other machines."""
    try:
        environment = client_environment(_place(data))
        check_answers(environment)
    except ServerError as error:
        _fail(str(error))
    # Before Prefect is imported, which reads its settings then; runs inherit them.
    os.environ.update({**WORKER_SETTINGS, **QUIET, **os.environ, **environment})
    from flows.serve.install import FEED_POOL, POOL
    from flows.serve.worker import FEEDERS, work

    console.print(f"working for {environment[URL]}, {limit} at a time; Ctrl-C stops", soft_wrap=True, highlight=False)
    try:
        work({POOL: limit, FEED_POOL: FEEDERS}, name)
    except ServerError as error:
        _fail(str(error))


def install(gpus: Gpus = 1, downloads: Downloads = 4, data: Data = None) -> None:
    """Install work pool, deployments, limits and automation in the Prefect server that PREFECT_API_URL names."""
    try:
        _install(_place(data), gpus, downloads)
    except ServerError as error:
        _fail(str(error))
    console.print("installed: work pool, deployments process-video and feed-batch, limits, crash detection")


def _install(place: Place, gpus: int, downloads: int) -> None:
    with connected(place):
        from flows.serve.install import Installation, Limits
        from flows.serve.install import install as install_all

        asyncio.run(install_all(Installation(Limits(gpus, downloads))))


def _place(data: Path | None) -> Place:
    return Place(data.expanduser().absolute()) if data else default_place()


def _fail(message: str) -> None:
    console.print("[red]error:[/]", escape(message), highlight=False, soft_wrap=True)
    raise typer.Exit(EXIT_NO_SERVER)
