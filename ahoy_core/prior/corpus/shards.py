"""The corpus on disk: one file a shard, written whole or not at all, made in any order by any number of processes."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from safetensors import safe_open
from safetensors.numpy import save_file

from ahoy_core.body.packaged import PackagedBody
from ahoy_core.formats.atomic import atomic_path
from ahoy_core.prior.corpus.clip import Clip, random_clip, random_scene
from ahoy_core.prior.corpus.dress import Dresser
from ahoy_core.prior.corpus.outfits import random_outfit
from ahoy_core.prior.corpus.wardrobe import SPLITS, Split, Wardrobe

Array = NDArray[Any]

PEOPLE: Final = 8  # a shard
SCENES: Final = 4  # a person: pose, cameras
PAINTS: Final = 4  # a scene
CLIPS: Final = PEOPLE * SCENES * PAINTS
VERSION: Final = 1
_NOTED: Final = ("prompt", "back_print")  # of a clip, in the metadata: what is no array


@dataclass(frozen=True)
class ShardId:
    """Which shard: its content follows from the split, the number and the corpus' seed alone."""

    split: Split
    number: int

    @property
    def name(self) -> str:
        """File name."""
        return f"{self.split}-{self.number:05d}.safetensors"


def make_shard(folder: Path, shard: ShardId, seed: int, body: PackagedBody, wardrobe: Wardrobe) -> Path:
    """Renders a shard, unless it is there already.

    Args:
        folder: of the corpus; exists.
        shard: which.
        seed: of the whole corpus.
        body: the packaged body.
        wardrobe: the garments.

    Returns:
        The file.
    """
    path = folder / shard.name
    if path.exists():
        return path
    rng = np.random.default_rng([seed, SPLITS.index(shard.split), shard.number])
    dresser = Dresser(body, wardrobe)
    clips: list[Clip] = []
    outfits: list[dict[str, Any]] = []
    for _ in range(PEOPLE):
        outfit = random_outfit(rng, shard.split)
        person = dresser.dress(outfit)
        for _ in range(SCENES):
            scene = random_scene(rng, body, person, shard.split)
            clips += [random_clip(rng, scene) for _ in range(PAINTS)]
            outfits += [{"suit": outfit.suit, "hair": outfit.hair, "shoes": outfit.shoes}] * PAINTS
    arrays = {
        field.name: np.stack([getattr(clip, field.name) for clip in clips])
        for field in fields(Clip)
        if field.name not in _NOTED
    }
    noted = {f"{name}s": [getattr(clip, name) for clip in clips] for name in _NOTED}
    meta = {"version": VERSION, "seed": seed, **noted, "outfits": outfits}
    with atomic_path(path) as temporary:
        save_file(arrays, temporary, {"ahoy": json.dumps(meta)})
    return path


def read_shard(path: Path, names: tuple[str, ...]) -> tuple[dict[str, Array], dict[str, Any]]:
    """Some arrays of a shard ([128, ...] each, see `Clip`) and its metadata.

    Raises:
        ValueError: when the shard was written by another version of the generator.
    """
    with safe_open(path, "numpy") as handle:
        meta = json.loads(handle.metadata()["ahoy"])
        if meta["version"] != VERSION:
            raise ValueError(
                f"expected a shard of version {VERSION}, got {meta['version']} in {path.name}; make it again"
            )
        return {name: handle.get_tensor(name) for name in names}, meta


def shards(folder: Path, split: Split) -> list[Path]:
    """The finished shards of a split, in order."""
    return sorted(folder.glob(f"{split}-*.safetensors"))


def claimed(folder: Path, wanted: list[ShardId]) -> Iterator[ShardId]:
    """Shards still to be made, each claimed by one process: a claim is a file that names the process.

    A claim whose process is gone is taken over; so an interrupted run goes on where it stopped.
    """
    for shard in wanted:
        if (folder / shard.name).exists():
            continue
        claim = folder / f".{shard.name}.claim"
        if claim.exists() and not _alive(claim.read_text()):
            claim.unlink(missing_ok=True)
        try:
            descriptor = os.open(claim, os.O_CREAT | os.O_EXCL | os.O_WRONLY)
        except FileExistsError:
            continue
        os.write(descriptor, str(os.getpid()).encode())
        os.close(descriptor)
        try:
            yield shard
        finally:
            claim.unlink(missing_ok=True)


def _alive(process: str) -> bool:
    try:
        os.kill(int(process), 0)
    except (ValueError, ProcessLookupError):
        return False
    except PermissionError:
        return True
    return True
