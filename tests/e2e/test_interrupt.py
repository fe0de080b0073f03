"""Runs that are stopped, and disks that fill up: a real process each, and nothing is lost."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from storage_schema.store import ArtifactStore
from storage_schema.tables import Tables
from tests.e2e.conftest import small_options


def _command(clip: Path, out: Path) -> list[str]:
    return [sys.executable, "-m", "flows", "run", str(clip), "--out", str(out), *small_options()]


def _states(out: Path) -> list[tuple[str, str]]:
    return [(r["stage"], r["state"]) for r in Tables(ArtifactStore(out / "store")).read("stages").to_pylist()]


@pytest.mark.slow
def test_after_ctrl_c_the_same_command_goes_on_where_it_stopped(models: None, demo_clip: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    process = subprocess.Popen(_command(demo_clip, out), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    manifests = out / "store" / "artifacts" / "ingest"
    while not list(manifests.glob("*/manifest*")) and process.poll() is None:
        time.sleep(0.05)
    time.sleep(0.3)  # into the next stage
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=120)
    assert process.returncode == 130 and "goes on from there" in output and "Traceback" not in output, output
    again = subprocess.run(_command(demo_clip, out), capture_output=True, text=True, check=False)
    assert again.returncode == 0, again.stdout + again.stderr
    states = _states(out)
    assert states.count(("ingest", "done")) == 1 and ("ingest", "cached") in states and ("report", "done") in states


def test_a_full_disk_is_said_and_leaves_no_half_artifact(demo_clip: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    code = (
        "import resource, signal, runpy, sys; signal.signal(signal.SIGXFSZ, signal.SIG_IGN);"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (65536, 65536));"
        f"sys.argv = {['ahoy', *_command(demo_clip, out)[3:], '--stages', 'ingest']!r};"
        "runpy.run_module('flows', run_name='__main__')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, env={**os.environ})
    assert done.returncode == 2 and "Traceback" not in done.stderr, done.stdout + done.stderr
    assert "error:" in done.stdout and ("space" in done.stdout or "large" in done.stdout), done.stdout
    assert not list(out.rglob("manifest*")) and not list(out.rglob("frames.npz*"))
