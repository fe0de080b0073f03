"""Models that run as external commands: a folder in, a folder out, no shell, a time limit, and the log in the error."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final, Generic, TypeVar

import torch
from torch import Tensor

from ahoy_core.conventions import Cameras
from ahoy_core.formats.images import read_png, to_float, to_uint8, write_png
from ahoy_core.models.adapter import Adapter, Fill
from ahoy_core.models.errors import CommandError

Options = TypeVar("Options")

LOG_TAIL: Final = 1500  # characters of the command's own words that an error repeats
_PASSED_ON: Final = (
    "PATH", "HOME", "LANG", "LC_ALL", "TMPDIR", "LD_LIBRARY_PATH", "CUDA_VISIBLE_DEVICES", "CUDA_HOME",
)  # fmt: skip
"""Of our environment: what programs need to run. Passwords and keys of the worker are none of the command's
business."""


@contextmanager
def exchange(prefix: str) -> Iterator[tuple[Path, Path]]:
    """A temporary folder with `in` and `out`, gone afterwards whatever happens."""
    with tempfile.TemporaryDirectory(prefix=f"ahoy-{prefix}-") as name:
        given, made = Path(name) / "in", Path(name) / "out"
        given.mkdir()
        made.mkdir()
        yield given, made


def run_command(fill: Fill, adapter: Adapter, given: Path, made: Path, more: Mapping[str, str] | None = None) -> None:
    """Run a fill's command once, with `{in}`, `{out}`, `{path}` (and `more`) put into its words.

    The command gets no standard input and a small environment, and is ended with all it started when time is up.

    Args:
        fill: its command, path and time limit.
        adapter: for messages.
        given: what the command reads.
        made: where it leaves its results.
        more: further names to put in.

    Raises:
        CommandError: it cannot be started, fails, or takes too long; its last words are in the text.
    """
    values = {"in": str(given), "out": str(made), "path": str(fill.path or ""), **(more or {})}
    words = [_put_in(word, values) for word in fill.command]
    environment = {name: os.environ[name] for name in _PASSED_ON if name in os.environ}
    log_path = made.parent / "command.log"
    with log_path.open("wb") as log:
        try:
            process = subprocess.Popen(
                words, cwd=made.parent, env=environment, stdin=subprocess.DEVNULL, stdout=log, stderr=log,
                start_new_session=True,
            )  # fmt: skip
        except OSError as error:
            raise CommandError(
                f"{adapter.label}: cannot start {words[0]!r} ({error}); correct command in roles.yaml"
            ) from error
        try:
            status = process.wait(fill.timeout_s)
        except subprocess.TimeoutExpired:
            raise CommandError(
                f"{adapter.label}: {words[0]!r} took longer than {fill.timeout_s:g} s and was ended; raise timeout_s "
                f"in roles.yaml, or see its last words: {_tail(log_path)}"
            ) from None
        finally:
            _end(process)
    if status != 0:
        raise CommandError(
            f"{adapter.label}: {words[0]!r} ended with status {status}; its last words: {_tail(log_path)}"
        )


class ExternalModel(Generic[Options]):
    """A role's model that runs as a command.

    Args:
        fill: its command and time limit.
        adapter: for messages.
        options: the knobs.
    """

    def __init__(self, fill: Fill, adapter: Adapter, options: Options) -> None:
        self.fill, self.adapter, self.options = fill, adapter, options


def _put_in(word: str, values: Mapping[str, str]) -> str:
    for name, value in values.items():
        word = word.replace("{" + name + "}", value)
    return word


def _end(process: subprocess.Popen[bytes]) -> None:
    """End the command and everything it started, also when we are interrupted."""
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def _tail(log: Path) -> str:
    return log.read_text(encoding="utf-8", errors="replace").strip()[-LOG_TAIL:] or "(it said nothing)"


def write_picture(path: Path, image: Tensor, alpha: Tensor | None = None) -> None:
    """Write [3,H,W] in [0,1], with alpha [1,H,W] as RGBA."""
    channels = image if alpha is None else torch.cat([image, alpha.to(image)])
    path.parent.mkdir(parents=True, exist_ok=True)
    write_png(path, to_uint8(channels))


def read_pictures(folder: Path, names: list[str], adapter: Adapter) -> list[Tensor]:
    """Pictures [3 or 4,H,W] in [0,1] that a command left.

    Raises:
        CommandError: naming those that are not there or cannot be read.
    """
    missing = [name for name in names if not (folder / name).is_file()]
    if missing:
        there = ", ".join(sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())[:12])
        raise CommandError(
            f"{adapter.label}: expected {', '.join(missing)} in the command's output, got {there or 'nothing'}; "
            "see docs/models.md for what it has to leave"
        )
    return [to_float(read_png(folder / name)) for name in names]


def write_cameras(path: Path, cameras: Cameras) -> None:
    """Write P cameras as JSON: OpenCV axes, `viewmats` world -> camera, `Ks` in pixels, centres at +0.5."""
    said = {
        "model": cameras.camera_model,
        "width": cameras.width,
        "height": cameras.height,
        "viewmats": cameras.viewmats.double().tolist(),
        "Ks": cameras.Ks.double().tolist(),
    }
    path.write_text(json.dumps(said), encoding="utf-8")
