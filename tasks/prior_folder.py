"""Which prior a run asks: the one that ships with the package, a folder of the user's, or none."""

from __future__ import annotations

import hashlib
import json
from functools import cache
from importlib import import_module, resources
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from ahoy_core.body.load import PACKAGED
from tasks.fills import Fills
from tasks.role import Role

NONE = "none"
_INDEX = "model_index.json"
_NEEDS = ("diffusers", "peft", "transformers")
_EMBEDDED = "FrameAutoencoder"


def prior_folder(source: str) -> Path:
    """Where the prior that `Settings.prior` names lies, whether or not it is there."""
    if source == PACKAGED:
        return Path(str(resources.files("ahoy_core.assets").joinpath("prior")))
    return Path(source).expanduser()


def fills_prior(source: str, fills: Fills) -> bool:
    """Whether `roles.yaml` says which video model a run asks: it does where the run's settings name none."""
    return source == PACKAGED and "video" in fills.chosen


def open_prior(source: str, fills: Fills) -> Any:
    """The video model of a run: the one of `roles.yaml`, kept by this process, or a folder's, loaded anew.

    Args:
        source: `Settings.prior`.
        fills: who fills the roles.

    Raises:
        ModelError: the filling cannot be loaded.
        PriorFormatError: the folder holds no prior.
    """
    if fills_prior(source, fills):
        return fills.get("video")
    from ahoy_core.prior.video import load_video

    return load_video(prior_folder(source))


def no_prior(source: str, body: str, fills: Fills) -> str:
    """Why a run cannot ask a prior; empty where it can.

    Args:
        source: `Settings.prior`.
        body: name or file of the run's body.
        fills: who fills the roles.

    Raises:
        FileNotFoundError: the user named a folder that holds no prior.
    """
    if source == NONE:
        return "switched off (prior=none)"
    if fills_prior(source, fills):
        return ""
    index = prior_folder(source) / _INDEX
    if not index.is_file():
        if source == PACKAGED:
            return "no trained prior ships with this version; name one with prior=FOLDER (docs/prior.md)"
        raise FileNotFoundError(f"expected a prior with {_INDEX} in {source!r}, got none; correct the knob `prior`")
    if missing := [name for name in _NEEDS if find_spec(name) is None]:
        return f"needs {', '.join(missing)}: pip install 'ahoy-avatars[prior]'"
    reads_bodies = json.loads(index.read_text(encoding="utf-8")).get("vae", ["", ""])[1] == _EMBEDDED
    if reads_bodies and body != PACKAGED:
        return "the prior knows the packaged body alone, and this run has another"
    return ""


def preload_prior(fills: Fills) -> None:
    """Import what the packaged prior needs (seconds of CPU time), for a process that runs are forked from.

    Nothing is done where runs will not ask it.
    """
    if fills_prior(PACKAGED, fills) or no_prior(PACKAGED, PACKAGED, fills):
        return
    for name in _NEEDS:
        import_module(name)
    open_prior(PACKAGED, fills)  # for what it imports only when it is read


def prior_role(source: str) -> Role:
    """The video model of a run, known by the contents of its weights and configurations."""
    folder = prior_folder(source)
    files = sorted(path for kind in ("*.safetensors", "*.json") for path in folder.rglob(kind))
    name = "embedded prior" if source == PACKAGED else f"{folder.name} (your folder)"
    licence = "Apache-2.0" if source == PACKAGED else "that of its folder"
    return Role(name, licence, _digest(tuple((path, path.stat().st_mtime_ns) for path in files)))


@cache
def _digest(versions: tuple[tuple[Path, int], ...]) -> str:
    digest = hashlib.sha256()
    for path, _ in versions:
        with path.open("rb") as handle:
            digest.update(hashlib.file_digest(handle, "sha256").digest())
    return digest.hexdigest()
