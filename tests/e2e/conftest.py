"""One small run of the main job on the bundled clip, shared by the tests that look at what it left."""

from __future__ import annotations

import fcntl
import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from flows.cli import app
from tasks import model_files

# The real stages at a size that takes seconds: the knobs that set it, not another code path.
SMALL = (
    "prior=none",  # tests/e2e/test_prior_run.py asks one
    "ingest.max_frames=6",
    "ingest.max_size=256",
    "texture.atlas_size=96",
    "texture.canonical_height=96",
    "texture.canonical_width=64",
    "coarse.map_size=64",
    "coarse.steps=3",
    "avatar.steps=2",
    "avatar.width=4",
    "avatar.check_every=1",
    "animate.height=96",
    "animate.width=64",
    "animate.turntable_frames=8",
    "animate.motion_frames=3",
)


def small_options() -> list[str]:
    return [word for knob in SMALL for word in ("--set", knob)]


def ahoy(*arguments: str) -> Result:
    return CliRunner().invoke(app, list(arguments))


@dataclass(frozen=True)
class SmallRun:
    output: str
    clip: Path
    out: Path

    @property
    def folder(self) -> Path:
        return next(path for path in self.out.iterdir() if path.name.startswith(self.clip.stem))

    def again(self, *more: str, knobs: Sequence[str] = ()) -> Result:
        extra = [word for knob in knobs for word in ("--set", knob)]
        return ahoy("run", str(self.clip), "--out", str(self.out), *small_options(), *extra, *more)


@pytest.fixture(scope="session")
def models() -> None:
    """Skips where the landmark networks have not been pulled."""
    missing = [status.model.name for status in model_files.verify() if status.state != "ok" and not status.left_out]
    if missing:
        pytest.skip(f"needs the networks {', '.join(missing)}: run `ahoy models pull`")


@pytest.fixture(scope="session")
def demo_clip() -> Path:
    return Path(str(resources.files("ahoy_core.assets").joinpath("demo.mp4")))


@pytest.fixture(scope="session")
def small_run(models: None, demo_clip: Path, tmp_path_factory: pytest.TempPathFactory) -> SmallRun:
    """Made once for all processes of the suite; each goes on from a copy of its own."""
    base = tmp_path_factory.getbasetemp()
    first = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "small-run"
    first.mkdir(exist_ok=True)
    with (first / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (first / "output.txt").exists():
            result = ahoy("run", str(demo_clip), "--out", str(first / "out"), *small_options())
            assert result.exit_code == 0, result.output
            (first / "output.txt").write_text(result.output)
    out = tmp_path_factory.mktemp("run") / "out"
    shutil.copytree(first / "out", out, symlinks=True)
    return SmallRun((first / "output.txt").read_text(), demo_clip, out)
