"""The server's folder on this machine: its secret, its address, and how clients find both."""

from __future__ import annotations

import json
import os
import secrets
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

from platformdirs import user_data_path

from flows.serve.errors import NoServerError, ServerError

HOME = "AHOY_SERVER"
URL, AUTH = "PREFECT_API_URL", "PREFECT_API_AUTH_STRING"
QUIET = {
    "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
    "DO_NOT_TRACK": "1",
    "PREFECT_SERVER_UI_SHOW_PROMOTIONAL_CONTENT": "false",
}
WORKER_SETTINGS = {
    "PREFECT_FLOWS_HEARTBEAT_FREQUENCY": "30",  # seconds; the shortest that Prefect allows
    "PREFECT_WORKER_QUERY_SECONDS": "2",  # how often an idle worker asks for work
    # While its database restarts the server answers 500 as well as 503; a run waits four minutes for it, not one.
    "PREFECT_CLIENT_RETRY_EXTRA_CODES": "500",
    "PREFECT_CLIENT_MAX_RETRIES": "7",
}
# Postgres refuses to run as root, and the user that it then runs as cannot enter /root.
_ROOT_FOLDER = Path("/var/lib/ahoy/server")


@dataclass(frozen=True)
class Address:
    """Where the running server answers.

    Attributes:
        url: of the API.
        pid: of the `ahoy server` that looks after it.
        auth: whether requests have to carry the password.
    """

    url: str
    pid: int
    auth: bool = True


@dataclass(frozen=True)
class Place:
    """The folder with the database, the secret and the address of one server."""

    folder: Path

    @property
    def database(self) -> Path:
        """Where embedded Postgres keeps its data."""
        return self.folder / "postgres"

    @property
    def logs(self) -> Path:
        """Where the server and the workers of this machine log."""
        return self.folder / "logs"

    def make(self) -> None:
        """Create the folder; others may pass through it (Postgres runs as another user under root) but not list it."""
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self.folder.chmod(0o711)
            self.logs.mkdir(mode=0o700, exist_ok=True)
        except OSError as error:
            raise ServerError(f"{self.folder} cannot be made ({error}); give another folder with --data") from error

    def secret(self) -> str:
        """Return the API's user and password, generated once into a file that only its owner can read.

        Raises:
            ServerError: the file can be read by others.
        """
        path = self.folder / "auth"
        try:
            descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        except FileExistsError:
            if path.stat().st_mode & 0o077:
                raise ServerError(f"{path} can be read by others; run: chmod 600 {path}") from None
            return path.read_text(encoding="ascii").strip()
        with os.fdopen(descriptor, "w", encoding="ascii") as file:
            file.write(f"ahoy:{secrets.token_urlsafe(32)}\n")
        return path.read_text(encoding="ascii").strip()

    def write_address(self, address: Address) -> None:
        """Tell clients of this machine where the server is."""
        partial = self.folder / f".address.{os.getpid()}"
        partial.write_text(json.dumps(asdict(address)), encoding="utf-8")
        partial.replace(self.folder / "address.json")

    def read_address(self) -> Address | None:
        """Return where the server was last started, None if it never was."""
        try:
            return Address(**json.loads((self.folder / "address.json").read_text(encoding="utf-8")))
        except (FileNotFoundError, ValueError, TypeError):
            return None


def default_place() -> Place:
    """Return the folder that AHOY_SERVER names, or the usual one of this system."""
    if given := os.environ.get(HOME):
        return Place(Path(given).expanduser().absolute())
    if hasattr(os, "geteuid") and os.geteuid() == 0:
        return Place(_ROOT_FOLDER)
    return Place(user_data_path("ahoy") / "server")


def client_environment(place: Place | None = None) -> dict[str, str]:
    """Return the settings with which Prefect's client reaches the server: the user's own, or this machine's.

    Raises:
        NoServerError: nothing is set and no server was started here.
    """
    if url := os.environ.get(URL):
        auth = os.environ.get(AUTH)
        return {URL: url} | ({AUTH: auth} if auth else {})
    place = place or default_place()
    address = place.read_address()
    if address is None:
        raise NoServerError(
            "no Prefect server is known on this machine: start one with `ahoy server`, or set PREFECT_API_URL"
        )
    return {URL: address.url} | ({AUTH: place.secret()} if address.auth else {})


@contextmanager
def connected(place: Place | None = None) -> Iterator[str]:
    """Point Prefect's client at the server for as long as the block runs, and check that it answers.

    Yields:
        The API's URL.

    Raises:
        NoServerError: nobody answers there, or the password is refused.
    """
    environment = client_environment(place)
    for name, value in QUIET.items():
        os.environ.setdefault(name, value)
    check_answers(environment)
    from prefect.settings import PREFECT_API_AUTH_STRING, PREFECT_API_URL, temporary_settings

    settings = {PREFECT_API_URL: environment[URL], PREFECT_API_AUTH_STRING: environment.get(AUTH)}
    with temporary_settings(updates=settings):
        yield environment[URL]


def check_answers(environment: Mapping[str, str], timeout_s: float = 10.0) -> None:
    """Ask the server for its version.

    Raises:
        NoServerError: see `connected`.
    """
    import httpx

    url = environment[URL]
    auth = httpx.BasicAuth(*environment[AUTH].split(":", 1)) if environment.get(AUTH) else None
    try:
        answer = httpx.get(f"{url.rstrip('/')}/admin/version", auth=auth, timeout=timeout_s)
    except httpx.HTTPError as error:
        raise NoServerError(
            f"no Prefect server answers at {url} ({type(error).__name__}): start it with `ahoy server`, "
            "or correct PREFECT_API_URL"
        ) from None
    if answer.status_code == 401:
        raise NoServerError(f"the server at {url} refuses the password: set PREFECT_API_AUTH_STRING to user:password")
    if answer.status_code != 200:
        raise NoServerError(f"expected a Prefect server at {url}, got HTTP status {answer.status_code}")
