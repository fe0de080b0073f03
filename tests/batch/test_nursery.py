"""The nursery and its relays, with a body that does what the environment says: real processes, no Prefect."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

from flows.serve import relay
from tests.batch.conftest import wait_for

ROOT = Path(__file__).resolve().parents[2]
BODY = """
import os, sys, time
from flows.serve.nursery import Nursery

def body():
    open(os.environ["NOTE"], "w").write(f"{os.getpid()} {os.getcwd()}")
    exec(os.environ["DO"])

nursery = Nursery(sys.argv[1], body)
os.write(1, b"ready\\n")
nursery.serve()
"""


class Nest:
    """A nursery process and the relays that a test starts."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.socket = folder / "s"
        command = [sys.executable, "-c", BODY, str(self.socket)]
        self.process = subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        assert self.process.stdout is not None and self.process.stdout.readline() == b"ready\n"

    def relay(self, do: str, name: str = "note") -> subprocess.Popen[Any]:
        environment = {"DO": do, "NOTE": str(self.folder / name), "PATH": os.environ["PATH"]}
        command = [sys.executable, "-I", "-S", relay.__file__, str(self.socket)]
        return subprocess.Popen(command, env=environment, cwd=self.folder, stderr=subprocess.DEVNULL)

    def pid(self, name: str = "note") -> int:
        note = self.folder / name
        return int(wait_for(lambda: note.exists() and note.read_text(), "the run to start").split()[0])


@pytest.fixture
def nest(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Nest]:
    made = Nest(tmp_path_factory.mktemp("n"))
    yield made
    made.process.kill()
    made.process.wait()


def _gone(pid: int) -> bool:
    return not psutil.pid_exists(pid) or psutil.Process(pid).status() == psutil.STATUS_ZOMBIE


@pytest.mark.parametrize(
    ("do", "status"),
    [
        ("pass", 0),
        ("sys.exit(3)", 3),
        ("sys.exit('words')", 1),
        ("raise ValueError", 1),
        ("os.kill(os.getpid(), 9)", -9),
        ("import ctypes; ctypes.string_at(0)", -signal.SIGSEGV),
    ],
)
def test_a_relay_ends_as_its_run_ends(nest: Nest, do: str, status: int) -> None:
    assert nest.relay(do).wait(30) == status


def test_a_run_gets_the_environment_and_the_folder_of_its_relay(nest: Nest) -> None:
    nest.relay("pass").wait(30)
    assert (nest.folder / "note").read_text().split()[1] == str(nest.folder)


def test_a_signal_to_the_relay_reaches_the_run(nest: Nest) -> None:
    process = nest.relay("import signal; signal.signal(15, lambda *a: sys.exit(7)); time.sleep(60)")
    nest.pid()
    time.sleep(0.3)  # the handler is set after the note is written
    process.terminate()
    assert process.wait(30) == 7


def test_a_killed_relay_takes_its_run_with_it_and_no_other(nest: Nest) -> None:
    first, second = nest.relay("time.sleep(60)", "first"), nest.relay("time.sleep(60)", "second")
    pids = nest.pid("first"), nest.pid("second")
    first.kill()
    wait_for(lambda: _gone(pids[0]), "the first run to be killed")
    assert not _gone(pids[1]) and second.poll() is None
    second.terminate()
    assert second.wait(30) == -signal.SIGTERM


def test_runs_are_finished_after_the_worker_is_gone_and_none_are_taken(nest: Nest) -> None:
    process = nest.relay("time.sleep(1)")
    nest.pid()
    assert nest.process.stdin is not None
    nest.process.stdin.close()
    assert process.wait(30) == 0 and nest.process.wait(30) == 0
    assert nest.relay("pass").wait(30) != 0


def test_a_killed_nursery_ends_its_relays_with_an_error(nest: Nest) -> None:
    process = nest.relay("time.sleep(3)")
    nest.pid()
    nest.process.kill()
    assert process.wait(30) == 1


def test_an_order_that_is_none_is_ignored(nest: Nest) -> None:
    import socket

    with socket.socket(socket.AF_UNIX) as stranger:
        stranger.connect(str(nest.socket))
        stranger.sendall(b"\0\0\0\5hello")
    assert nest.relay("pass").wait(30) == 0
