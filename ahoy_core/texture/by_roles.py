"""Texture with real models: DensePose's word on which limb a pixel shows, FLUX's and SyncHuman's on what is unseen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ahoy_core.conventions import GREY
from ahoy_core.models.contracts import Inpaint, SurfaceParts, Views
from ahoy_core.models.densepose import PARTS as DENSE_PARTS
from ahoy_core.texture.surface import ARM, LEG, PARTS, REFERENCE_HEIGHT, SeenFrame, Surface, height_in_pixels
from ahoy_core.texture.texture import Texture

REACH = 5.0  # pixels of a body 200 pixels tall by which DensePose and the fit may disagree on where a limb ends
PIECE = 32  # frames handed to a model at once
KNOWN = 128  # of 255: coverage from which a pixel of a canonical view counts as observed
_NOTHING = 0.02  # difference from grey below which a generated view shows nothing
_LIMB_WORDS = {ARM: "arm", LEG: "leg"}
_PART_WORDS = {"head": "head", "hands": "hand", "feet": "foot"}

Parts = NDArray[np.uint8]


def parts_by(surface: SurfaceParts, frames: Parts, boxes: NDArray[np.float32], used: NDArray[np.bool_]) -> Parts:
    """DensePose's parts [T,H,W] of the subject in the used frames.

    Args:
        surface: the role.
        frames: [T,H,W,3] sRGB.
        boxes: [T,4] x0 y0 x1 y1 of the visible person.
        used: [T]; others are 0.
    """
    there = torch.where(torch.from_numpy(used)[:, None], torch.from_numpy(boxes).float(), float("nan"))
    out = []
    for start in range(0, len(frames), PIECE):
        rows = slice(start, start + PIECE)
        pictures = torch.from_numpy(np.ascontiguousarray(frames[rows])).permute(0, 3, 1, 2).float() / 255
        out.append(surface(pictures, there[rows]).part.numpy())
    return np.concatenate(out)


def agreement(surface: Surface, parts: Parts) -> Callable[[int, SeenFrame], SeenFrame]:
    """What a frame's trust becomes where DensePose sees another limb than the fitted body has there.

    Args:
        surface: the body's triangles.
        parts: [T,H,W] from `parts_by`.

    Returns:
        Maps a frame's number and what the fit says of it to what both say.
    """
    words = np.array(DENSE_PARTS)
    of_face = np.array([_word(surface, face) for face in range(len(surface.faces))])

    def checked(number: int, seen: SeenFrame) -> SeenFrame:
        size = 2 * max(1, round(REACH * height_in_pixels(seen.hits) / REFERENCE_HEIGHT)) + 1
        near = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
        said = words[parts[number]]
        agreed = np.zeros(seen.valid.shape, dtype=bool)
        for word in set(_PART_WORDS.values()) | set(_LIMB_WORDS.values()) | {"torso"}:
            around = cv2.dilate((said == word).astype(np.uint8), near) > 0
            agreed |= around & (of_face[seen.hits.face] == word)
        return replace(seen, valid=seen.valid & agreed)

    return checked


def _word(surface: Surface, face: int) -> str:
    """What DensePose would call a triangle."""
    part = PARTS[surface.part[face]]
    if part in _PART_WORDS:
        return _PART_WORDS[part]
    limbs = surface.limb[surface.faces[face]]
    return _LIMB_WORDS.get(int(np.bincount(limbs).argmax()), "torso")


def complete_by(
    texture: Texture, inpaint: Inpaint | None, views: Views | None, prompt: str = "", seed: int = 0
) -> Texture:
    """The canonical views with what was never seen made up by models; what was seen stays as it was seen.

    First the front view's holes are filled, then the other sides are made from it (paper, section 3.1). The atlas keeps
    its own filling.

    Args:
        texture: with views completed from the atlas; they stay where a model shows nothing.
        inpaint: the role, or None.
        views: the role, or None.
        prompt: for `inpaint`.
        seed: for `inpaint`.
    """
    if inpaint is None and views is None:
        return texture
    colour, alpha = _channels(texture.views)
    known = torch.from_numpy(texture.view_coverage)[:, None].float() / 255
    if inpaint is not None:
        part, part_alpha = _channels(texture.partial[None])
        seen = (part_alpha[0] > 0) & (known[0] * 255 >= KNOWN)
        picture = torch.where(seen, part[0], torch.tensor(GREY))
        hole = ((alpha[0] > 0) & ~seen).float()
        colour[0] = _kept(colour[0], inpaint(picture, hole, prompt, seed), known[0])
    if views is not None:
        made, azimuths = views(colour[0] * alpha[0] + GREY * (1 - alpha[0]), alpha[0])
        for azimuth, picture in zip(azimuths, made, strict=True):
            side = round(azimuth / 90) % len(colour)
            shown = ((picture - GREY).abs().amax(0, keepdim=True) > _NOTHING).float()
            colour[side] = _kept(colour[side], picture * shown + colour[side] * (1 - shown), known[side])
    rgba = torch.cat([colour.clamp(0, 1), alpha], 1).permute(0, 2, 3, 1)
    return replace(texture, views=(255 * rgba).round().to(torch.uint8).numpy())


def _kept(observed: Tensor, made: Tensor, known: Tensor) -> Tensor:
    return observed * known + made.to(observed) * (1 - known)


def _channels(rgba: NDArray[np.uint8]) -> tuple[Tensor, Tensor]:
    """[N,H,W,4] uint8 -> colour [N,3,H,W] and alpha [N,1,H,W]."""
    values = torch.from_numpy(np.ascontiguousarray(rgba)).permute(0, 3, 1, 2).float() / 255
    return values[:, :3].clone(), values[:, 3:].clone()
