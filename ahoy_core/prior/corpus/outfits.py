"""Who stands there: random bodies and what they wear, by split."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from ahoy_core.prior.corpus import wardrobe
from ahoy_core.prior.corpus.wardrobe import Split

Lower = Literal["trousers", "skirt"]

_BALD = 0.05
_CAP = 0.3  # share of heads with short procedural hair
_SHELL = 0.5  # share of people in procedural garments
_SKIRT = 0.15


@dataclass(frozen=True)
class Shell:
    """Procedural clothes: layers over the skin.

    Attributes:
        sleeve: share of the arm covered, 0 (none) to 1 (to the wrist).
        leg: share of the leg covered by the lower garment.
        lower: which garment that is.
        waist: metres above the hip joints where upper and lower meet.
        ease_upper: metres between skin and cloth.
        ease_lower: metres, at the hem.
        flare: of a skirt, metres a metre.
    """

    sleeve: float
    leg: float
    lower: Lower
    waist: float
    ease_upper: float
    ease_lower: float
    flare: float


@dataclass(frozen=True)
class Outfit:
    """A person: body shape and what covers it.

    Attributes:
        betas: [S] of the packaged body.
        suit: a MakeHuman suit, or None where `cloth` is worn.
        cloth: procedural clothes, or None.
        shoes: MakeHuman shoes, or None (barefoot).
        hair: MakeHuman hair; "cap" for short procedural hair; None for bald.
        brows: MakeHuman eyebrows.
        textured: whether the suit's own texture is used.
    """

    betas: Tensor
    suit: str | None
    cloth: Shell | None
    shoes: str | None
    hair: str | None
    brows: str
    textured: bool


def random_outfit(rng: np.random.Generator, split: Split) -> Outfit:
    """A random person of a split (see `wardrobe` for what each split may wear)."""
    female = bool(rng.random() < 0.5)
    shell = split not in ("mesh", "texture") and bool(rng.random() < _SHELL)
    suit = None if shell else _suit(rng, split)
    textured = split == "texture" or (suit is not None and suit not in wardrobe.UNTEXTURED)
    shoes = wardrobe.HELD_OUT_SHOES if split == "mesh" else wardrobe.SHOES
    return Outfit(
        betas=_betas(rng, female),
        suit=suit,
        cloth=_shell(rng) if shell else None,
        shoes=None if shell and rng.random() < 0.08 else str(rng.choice(shoes)),
        hair=_hair(rng, split),
        brows=str(rng.choice(wardrobe.BROWS)),
        textured=textured and bool(split == "texture" or rng.random() < 0.75),
    )


def _suit(rng: np.random.Generator, split: Split) -> str:
    if split == "mesh":
        return str(rng.choice(wardrobe.HELD_OUT_SUITS))
    return str(rng.choice(wardrobe.UNTEXTURED if split == "texture" else wardrobe.SUITS))


def _hair(rng: np.random.Generator, split: Split) -> str | None:
    if split == "mesh":
        return str(rng.choice(wardrobe.HELD_OUT_HAIR))
    draw = rng.random()
    if draw < _BALD:
        return None
    return "cap" if draw < _BALD + _CAP else str(rng.choice(wardrobe.HAIR))


def _betas(rng: np.random.Generator, female: bool) -> Tensor:
    """Adults: gender, age, muscle, weight, height, proportions."""
    low = [0.8 if female else 0.0, 0.6, 0.3, 0.3, 0.2, 0.35]
    high = [1.0 if female else 0.2, 0.97, 0.8, 0.8, 0.7, 0.75]
    return torch.tensor(rng.uniform(low, high), dtype=torch.float32)


def _shell(rng: np.random.Generator) -> Shell:
    skirt = bool(rng.random() < _SKIRT)
    leg = rng.uniform(0.35, 0.8) if skirt else float(rng.choice([rng.uniform(0.3, 0.5), rng.uniform(0.9, 1.0)]))
    return Shell(
        sleeve=float(rng.choice([0.0, rng.uniform(0.2, 0.5), rng.uniform(0.85, 1.0)], p=[0.15, 0.5, 0.35])),
        leg=float(leg),
        lower="skirt" if skirt else "trousers",
        waist=float(rng.uniform(-0.02, 0.14)),
        ease_upper=float(rng.uniform(0.006, 0.03)),
        ease_lower=float(rng.uniform(0.006, 0.03)),
        flare=float(rng.uniform(0.05, 0.45)),
    )
