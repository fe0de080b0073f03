"""Texture with real models: DensePose's word on what a pixel shows, FLUX's and SyncHuman's on what is unseen."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ahoy_core.body.load import load_body
from ahoy_core.body.model import BodyModel
from ahoy_core.body.register import vertices_on
from ahoy_core.conventions import GREY
from ahoy_core.formats.densepose import SMPL_VERTICES
from ahoy_core.models.contracts import Inpaint, SurfaceParts, Views
from ahoy_core.models.errors import CheckpointError
from ahoy_core.models.people_adapters import SMPL_FILES, TABLE_FILE
from ahoy_core.texture.dense import ChartMap, DenseSurface, chart_map
from ahoy_core.texture.surface import Surface
from ahoy_core.texture.texture import Texture

PIECE = 32  # frames handed to a model at once
KNOWN = 128  # of 255: coverage from which a pixel of a canonical view counts as observed
_NOTHING = 0.02  # difference from grey below which a generated view shows nothing


def dense_by(
    role: SurfaceParts,
    surface: Surface,
    frames: NDArray[np.uint8],
    boxes: NDArray[np.float32],
    used: NDArray[np.bool_],
    charts: ChartMap | None = None,
) -> DenseSurface:
    """What DensePose says of the subject in the used frames.

    Args:
        role: the role "surface".
        surface: the body's triangles.
        frames: [T,H,W,3] sRGB.
        boxes: [T,4] x0 y0 x1 y1 of the visible person.
        used: [T]; the others get no part.
        charts: where its charts lie on the body, or None.
    """
    there = torch.where(torch.from_numpy(used)[:, None], torch.from_numpy(boxes).float(), float("nan"))
    parts, uvs = [], []
    for start in range(0, len(frames), PIECE):
        rows = slice(start, start + PIECE)
        pictures = torch.from_numpy(np.ascontiguousarray(frames[rows])).permute(0, 3, 1, 2).float() / 255
        found = role(pictures, there[rows])
        parts.append(found.part.numpy())
        uvs.append((255 * found.uv).round().to(torch.uint8).permute(0, 2, 3, 1).numpy())
    return DenseSurface(surface, np.concatenate(parts), np.concatenate(uvs), charts)


def charts_on(role: Any, body: BodyModel, surface: Surface) -> ChartMap | None:
    """Where the role's charts lie on the body: by its table where the user gave one, None where not.

    Args:
        role: the role "surface", with `table` and `smpl` (`ahoy_core.models.densepose.DensePose`).
        body: the run's body.
        surface: its triangles.

    Raises:
        CheckpointError: the table is there, but not the SMPL file that its vertices belong to.
    """
    table = getattr(role, "table", None)
    if table is None:
        return None
    if len(body.lbs_weights) == SMPL_VERTICES:
        smpl = body
    elif role.smpl is None:
        raise CheckpointError(
            f"expected SMPL's own file beside {TABLE_FILE}, whose charts lie on its {SMPL_VERTICES} vertices, got none "
            f"and the body {body.name!r}; put one of {', '.join(SMPL_FILES)} there, or take the table away"
        )
    else:
        smpl = load_body(str(role.smpl))
    still = torch.zeros(1, body.n_joints, 3)
    with torch.no_grad():
        rest = body(still, body.default_betas[None], still[:, 0]).vertices[0]
        placed = rest if smpl is body else vertices_on(smpl, body)
    return chart_map(table, placed.double().numpy(), surface, rest.double().numpy())


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
