"""The Dockerfile, by Docker's own parser; its entrypoint and its health check, run for real."""

from __future__ import annotations

import os
import subprocess
import sys
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from threading import Thread

import dockerfile
import pytest

from .facts import DEPLOY, ROOT, UID, VERSION, check_command, entrypoint_variables, extra, is_known_variable, pinned

PATH = DEPLOY / "Dockerfile"
ENTRYPOINT = DEPLOY / "entrypoint.sh"
INSTRUCTIONS = {
    "ADD", "ARG", "CMD", "COPY", "ENTRYPOINT", "ENV", "EXPOSE", "FROM", "HEALTHCHECK", "LABEL", "RUN", "SHELL", "USER",
    "VOLUME", "WORKDIR",
}  # fmt: skip
LINES = dockerfile.parse_file(str(PATH))


def lines(command: str) -> list[dockerfile.Command]:
    return [line for line in LINES if line.cmd.upper() == command]


def unfit(text: str) -> list[str]:
    """What is wrong by Docker's parser and its list of instructions (which the parser alone does not know)."""
    try:
        found = dockerfile.parse_string(text)
    except dockerfile.GoParseError as error:
        return [str(error)]
    return [line.original for line in found if line.cmd.upper() not in INSTRUCTIONS or not any(line.value)]


def test_docker_can_read_it() -> None:
    assert unfit(PATH.read_text()) == []


@pytest.mark.parametrize("broken", ["FORM python", "FROM python\nRUN", "", "FROM python\nCOPY <<END /x\nunfinished"])
def test_the_parser_notices_mistakes(broken: str) -> None:
    assert unfit(broken)


def test_it_has_two_stages_and_the_last_takes_only_what_was_built() -> None:
    stages = [line.value[2] for line in lines("FROM")]
    assert stages == ["build", "run"]
    last = LINES[LINES.index(lines("FROM")[-1]) :]
    copied = [line for line in last if line.cmd.upper() == "COPY"]
    assert [line.flags for line in copied] == [("--from=build",), ("--chmod=0555",)]
    assert not [line for line in last if "pip" in line.original]


def test_images_are_pinned_to_the_python_of_the_pinned_set() -> None:
    assert not [line for line in lines("FROM") if ":" not in line.value[0] or "latest" in line.value[0]]
    python = next(line.value[0].split("=")[1] for line in lines("ARG") if line.value[0].startswith("PYTHON_VERSION"))
    assert f"Python {python}" in (ROOT / "constraints.txt").read_text().splitlines()[0]


def test_it_installs_the_pinned_set_and_only_it() -> None:
    installs = [line.original for line in lines("RUN") if "pip install" in line.original]
    assert len(installs) == 1 and "--constraint constraints.txt" in installs[0]
    default = next(line.value[0].split("=")[1] for line in lines("ARG") if line.value[0].startswith("EXTRAS"))
    for name in default.split(","):
        assert all(requirement.name in pinned() for requirement in extra(name))


def test_every_copied_file_exists_and_gets_past_the_ignore_file() -> None:
    ignored = (ROOT / ".dockerignore").read_text().split()
    for line in lines("COPY"):
        if "--from=build" in line.flags:
            continue
        for source in line.value[:-1]:
            assert (ROOT / source).exists() and f"!{source}" in ignored
    packages = {path.parent.name for path in ROOT.glob("*/__init__.py")} - {"tests", "benchmarks"}
    assert packages <= {value for line in lines("COPY") for value in line.value}


def test_it_runs_as_nobody_in_particular() -> None:
    assert [line.value for line in lines("USER")] == [(f"{UID}:{UID}",)]
    assert f"--uid {UID}" in " ".join(line.original for line in lines("RUN"))
    assert LINES.index(lines("USER")[0]) > LINES.index(lines("COPY")[-1])
    assert not lines("ADD")


def test_its_variables_are_read_and_its_folders_belong_to_it() -> None:
    last = lines("ENV")[-1].value
    names = dict(zip(last[::2], last[1::2], strict=True))
    assert all(is_known_variable(name) for name in names), names
    owned = next(line.original for line in lines("RUN") if "install -d -o" in line.original)
    for folder in lines("VOLUME")[0].value:
        assert folder in owned
    for name in ("AHOY_MODELS", "AHOY_SOURCE_CACHE", "PREFECT_HOME", "NUMBA_CACHE_DIR", "AHOY_SERVER", "HOME"):
        assert names[name].startswith(tuple(lines("VOLUME")[0].value)), f"{name} is not writable"


def test_its_commands_exist_and_its_labels_are_true() -> None:
    assert lines("CMD")[0].json and lines("ENTRYPOINT")[0].json
    check_command(list(lines("CMD")[0].value))
    assert f'"{VERSION}"' in lines("LABEL")[0].value
    assert (DEPLOY / "entrypoint.sh").read_text().startswith("#!/bin/sh\n") and os.access(ENTRYPOINT, os.X_OK)


def health(url: str) -> int:
    command = [sys.executable, *lines("HEALTHCHECK")[0].value[2:]]
    assert lines("HEALTHCHECK")[0].value[:2] == ("CMD", "python")
    environment = {**os.environ, "PREFECT_API_URL": url}
    return subprocess.run(command, env=environment, stderr=subprocess.DEVNULL, check=False).returncode


def test_the_health_check_tells_a_server_that_answers_from_one_that_does_not() -> None:
    class Api(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200 if self.path == "/api/health" else 503)
            self.end_headers()

        def log_message(self, format: str, *args: object) -> None:
            return

    with HTTPServer(("127.0.0.1", 0), Api) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        assert health(f"http://127.0.0.1:{server.server_port}/api") == 0
        assert health(f"http://127.0.0.1:{server.server_port}/wrong") != 0
        server.shutdown()
    assert health("http://127.0.0.1:1/api") != 0


def enter(folder: Path, *command: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run the entrypoint with a stand-in for `ahoy` that prints its environment and arguments."""
    (folder / "bin").mkdir(exist_ok=True)
    (folder / "bin" / "ahoy").write_text('#!/bin/sh\nenv\necho "arguments: $*"\n')
    (folder / "bin" / "ahoy").chmod(0o755)
    clean = {"PATH": f"{folder / 'bin'}:/usr/bin:/bin", "AHOY_SERVER": str(folder / "server"), **environment}
    return subprocess.run(
        ["/bin/sh", str(ENTRYPOINT), *command], env=clean, capture_output=True, text=True, check=False
    )


def test_the_entrypoint_takes_every_secret_from_its_file(tmp_path: Path) -> None:
    odd = "ahoy:p@ss $(id) `id` \"quoted\" 'x' \\n"
    environment = {}
    for name in entrypoint_variables():
        (tmp_path / name).write_text(odd + "\n")
        environment[f"{name}_FILE"] = str(tmp_path / name)
    done = enter(tmp_path, "ahoy", "worker", "--name", "a b", **environment)
    assert done.returncode == 0 and "arguments: worker --name a b" in done.stdout
    for name in entrypoint_variables():
        assert f"\n{name}={odd}\n" in "\n" + done.stdout and f"{name}_FILE" not in done.stdout
    assert not (tmp_path / "server").exists()


def test_the_entrypoint_gives_the_server_its_password_in_a_file_of_its_own(tmp_path: Path) -> None:
    done = enter(tmp_path, "ahoy", "server", "--host", "0.0.0.0", PREFECT_API_AUTH_STRING="ahoy:geheim")
    assert done.returncode == 0 and "arguments: server --host 0.0.0.0" in done.stdout
    password = tmp_path / "server" / "auth"
    assert password.read_text() == "ahoy:geheim\n" and password.stat().st_mode & 0o077 == 0


def test_the_entrypoint_stops_where_a_secret_is_missing(tmp_path: Path) -> None:
    done = enter(tmp_path, "ahoy", "worker", PREFECT_API_AUTH_STRING_FILE=str(tmp_path / "nothing"))
    assert done.returncode != 0 and "arguments" not in done.stdout
