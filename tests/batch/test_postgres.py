"""Embedded Postgres: as root and as somebody else, started twice, stopped, killed, and seen by nobody else."""

from __future__ import annotations

import asyncio
import os
import pwd
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import asyncpg
import pytest

from flows.serve.errors import ServerError
from flows.serve.place import NoServerError, Place, check_answers, client_environment
from flows.serve.postgres import Postgres
from flows.serve.prefect_server import check_port
from tests.batch.conftest import free_port, kill, wait_for


@pytest.fixture
def folder() -> Iterator[Path]:
    made = Path(tempfile.mkdtemp(prefix="ahoy-pg-"))
    made.chmod(0o755)
    yield made
    shutil.rmtree(made)


def _query(postgres: Postgres, text: str) -> object:
    async def ask() -> object:
        connection = await asyncpg.connect(
            host=postgres.url.partition("host=")[2], user="postgres", database="postgres"
        )
        try:
            return await connection.fetchval(text)
        finally:
            await connection.close()

    return asyncio.run(ask())


def test_what_is_written_survives_a_stop_and_a_kill(folder: Path) -> None:
    postgres = Postgres(folder / "data")
    postgres.start()
    try:
        _query(postgres, "CREATE TABLE t AS SELECT 7 AS x")
        first = postgres.pid()
        postgres.start()
        assert postgres.pid() == first, "a second start found it running"
        postgres.stop()
        assert not postgres.running()
        postgres.start()
        assert _query(postgres, "SELECT x FROM t") == 7
        pid = postgres.pid()
        assert pid is not None
        kill(pid)
        wait_for(lambda: not os.path.exists(f"/proc/{pid}"), "Postgres to be gone")  # noqa: PTH110
        postgres.start()
        assert _query(postgres, "SELECT x FROM t") == 7
    finally:
        postgres.stop()


def test_it_listens_on_no_port_and_its_socket_is_its_owners(folder: Path) -> None:
    postgres = Postgres(folder / "data")
    postgres.start()
    try:
        assert _query(postgres, "SHOW listen_addresses") == ""
        assert (folder / "data").stat().st_mode & 0o077 == 0
    finally:
        postgres.stop()


def test_a_path_too_long_for_a_socket_works(folder: Path) -> None:
    postgres = Postgres(folder / ("d" * 100) / "data")
    postgres.start()
    try:
        assert _query(postgres, "SELECT 1") == 1
    finally:
        postgres.stop()


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root to become somebody else")
def test_it_runs_for_somebody_who_is_not_root(folder: Path) -> None:
    nobody = pwd.getpwnam("nobody")
    os.chown(folder, nobody.pw_uid, nobody.pw_gid)
    pid = os.fork()
    if pid == 0:  # by forking: the interpreter may lie where nobody else can execute it
        os.setgroups([])
        os.setgid(nobody.pw_gid)
        os.setuid(nobody.pw_uid)
        postgres = Postgres(folder / "data")
        postgres.start()
        ran = postgres.running()
        postgres.stop()
        os._exit(0 if ran and not postgres.running() else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0


def test_a_taken_port_is_refused_with_what_to_do() -> None:
    import socket

    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(ServerError, match="--port"):
            check_port("127.0.0.1", taken.getsockname()[1])


def test_no_server_is_said_with_how_to_start_one(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("PREFECT_API_URL", raising=False)
    with pytest.raises(NoServerError, match="ahoy server"):
        client_environment(Place(folder))
    with pytest.raises(NoServerError, match="ahoy server"):
        check_answers({"PREFECT_API_URL": f"http://127.0.0.1:{free_port()}/api"})


def test_the_password_is_made_once_and_refused_if_others_can_read_it(folder: Path) -> None:
    place = Place(folder)
    secret = place.secret()
    assert place.secret() == secret and len(secret) > 40
    assert (folder / "auth").stat().st_mode & 0o777 == 0o600
    (folder / "auth").chmod(0o644)
    with pytest.raises(ServerError, match="chmod 600"):
        place.secret()
