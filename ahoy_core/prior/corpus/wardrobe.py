"""Which garments, hair and motions are trained on, which are held out, and which are never touched."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any, Final, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from ahoy_core.prior.corpus.makehuman import AssetError, Garment, read_garment

Array = NDArray[Any]
Split = Literal["train", "people", "mesh", "texture", "motion"]

SPLITS: Final[tuple[Split, ...]] = ("train", "people", "mesh", "texture", "motion")
"""Training; and held out: new people in known clothes, unknown garment meshes, unknown textures, unknown motions."""

NEVER: Final = ("male_casualsuit03", "female_casualsuit01", "shoes06", "shoes05", "short02", "ponytail01")
"""What the development captures' subjects wear: in no split, so that captures stay a test."""

SUITS: Final = (
    "female_casualsuit02",
    "male_casualsuit01",
    "male_casualsuit02",
    "male_casualsuit04",
    "male_casualsuit06",
    "male_elegantsuit01",
)
HELD_OUT_SUITS: Final = ("male_casualsuit05",)
UNTEXTURED: Final = ("male_casualsuit02", "male_casualsuit06")
"""Trained on in plain and procedural colours only; their own textures are the split `texture`."""
SHOES: Final = ("shoes01", "shoes02", "shoes03")
HELD_OUT_SHOES: Final = ("shoes04",)
HAIR: Final = ("bob02", "braid01", "long01", "short01", "short03")
HELD_OUT_HAIR: Final = ("short04",)
BROWS: Final = tuple(f"eyebrow{k:03d}" for k in range(1, 13))

TEXTURE_SIZE: Final = 256  # a garment's texture covers about 60 pixels of a person image, so this is no bottleneck


class Wardrobe:
    """Garments of a folder, read once each.

    Args:
        folder: MakeHuman's assets, with `clothes`, `hair` and `eyebrows` in it.

    Raises:
        AssetError: when the folder is not that.
    """

    def __init__(self, folder: Path) -> None:
        missing = [name for name in ("clothes", "hair", "eyebrows") if not (folder / name).is_dir()]
        if missing:
            raise AssetError(f"expected MakeHuman's asset folder, got {str(folder)!r} without {', '.join(missing)}")
        self.folder = folder
        self._garments: dict[str, Garment] = {}

    def garment(self, kind: str, name: str) -> Garment:
        """A garment of `clothes`, `hair` or `eyebrows`."""
        key = f"{kind}/{name}"
        if key not in self._garments:
            self._garments[key] = read_garment(self.folder / key)
        return self._garments[key]


@lru_cache(maxsize=64)
def texture(diffuse: Path | None, occlusion: Path | None, opaque: bool) -> Array:
    """A texture [S,S,4] uint8 (sRGB, alpha), the occlusion map multiplied in; white where there is none.

    Args:
        diffuse: colour file.
        occlusion: file whose grey multiplies the colour.
        opaque: ignore the file's alpha.
    """
    image = np.full((TEXTURE_SIZE, TEXTURE_SIZE, 4), 255, dtype=np.uint8)
    if diffuse is not None:
        image = _read(diffuse)
    if occlusion is not None:
        shade = _read(occlusion)[..., :3].astype(np.float32).mean(-1, keepdims=True) / 255
        image[..., :3] = (image[..., :3] * shade).astype(np.uint8)
    if opaque:
        image[..., 3] = 255
    return image


def _read(path: Path) -> Array:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise AssetError(f"expected a picture, got {str(path)!r}, which cannot be read; check SHA256SUMS")
    if image.ndim == 2:
        image = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    image = cv2.resize(image, (TEXTURE_SIZE, TEXTURE_SIZE), interpolation=cv2.INTER_AREA)
    alpha = image[..., 3:] if image.shape[2] == 4 else np.full_like(image[..., :1], 255)
    return np.ascontiguousarray(np.concatenate([image[..., 2::-1], alpha], -1))
