"""Carries the colours of held tokens over the body to everything that shows the same place: attention by place alone.

A network of this size learns slowly to find the same place of the body in another view, and hardly to copy its colour.
Both are known here: body maps say where on the body each cell is, and held latents say which colour was there. So
each cell is told the colours that were held near its place, near and wide (a patch, a garment); what the network has to
learn is what differs: light, folds, what lies on the other side.
"""

from __future__ import annotations

from typing import Final

import torch
from torch import Tensor, nn

from ahoy_core.prior.bodymaps import CELL

FACTOR: Final = 8  # pixels a latent, along each axis
_CELLS: Final = FACTOR // CELL  # a latent's cells, along each axis
_TOKEN: Final = 2 * _CELLS  # a token's cells, along each axis
_CARRIED: Final = 7  # a cell's colour from near by and from further off, and how near the nearest was
CARRIED_CHANNELS: Final = _CARRIED * _CELLS**2
_NEAR, _WIDE = 0.04, 0.15  # of half of the body's height: 3 cm, and 13
_DEPTH: Final = 0.2  # front and back of one height are near each other: cloth mostly has one colour all round
_MIRROR: Final = 0.12  # how much further off the same place of the other side is: three `_NEAR`, it only stands in
_INSIDE: Final = 0.9  # silhouette from which a cell shows nothing but the person
_GROW: Final = 2  # cells: hair and cloth stand off the bare body
_MOST: Final = 384  # held cells used of a clip: more say the same again


def cell_colours(latents: Tensor, readout: Tensor) -> Tensor:
    """Mean colours of cells, read off latents by a linear map.

    Args:
        latents: [B,C,T,h,w], normalized.
        readout: [12,C+1] of the autoencoder (`cell_readout`), the last column a constant.

    Returns:
        [B,T,3,2h,2w], sRGB in about [-1,1].
    """
    weight, bias = readout[:, :-1], readout[:, -1]
    folded = torch.einsum("kc,bcthw->btkhw", weight, latents) + bias[:, None, None]
    return nn.functional.pixel_shuffle(folded, _CELLS)


@torch.no_grad()
def carried_colours(latents: Tensor, held: Tensor, body: Tensor, readout: Tensor) -> Tensor:
    """What the held tokens say of every latent's place on the body.

    Args:
        latents: [B,C,T,h,w], normalized; looked at where held alone.
        held: [B,T,h/2,w/2] bool.
        body: [B,T,7,2h,2w] `body_maps`.
        readout: [12,C+1], see `cell_colours`.

    Returns:
        [B,CARRIED_CHANNELS,T,h,w]: 0 where there is no body near, and everywhere where no held token shows one.
    """
    colours = cell_colours(latents, readout)
    known = held.repeat_interleave(_TOKEN, -1).repeat_interleave(_TOKEN, -2)
    carried = torch.zeros(*body.shape[:2], _CARRIED, *body.shape[-2:])
    for one in range(len(body)):
        silhouette = body[one, :, 0]
        source = known[one] & (silhouette > _INSIDE)
        if source.any():
            place, there = _grown_places(body[one])
            target = there & ~known[one]
            told = _carry(_at(place, source), _at(colours[one], source), _at(place, target))
            carried[one].permute(0, 2, 3, 1)[target] = told
    return nn.functional.pixel_unshuffle(carried, _CELLS).transpose(1, 2)


def _at(maps: Tensor, where: Tensor) -> Tensor:
    """Maps [T,K,H,W] where [T,H,W] holds -> [N,K]."""
    return maps.permute(0, 2, 3, 1)[where]


def _grown_places(body: Tensor) -> tuple[Tensor, Tensor]:
    """Places [T,3,H,W], carried a little beyond the silhouette, and where there is one [T,H,W] bool."""
    silhouette = body[:, :1]
    there = (silhouette > 0.02).float()
    place = body[:, 1:4] / silhouette.clamp(min=0.02) * there
    for _ in range(_GROW):
        share = nn.functional.avg_pool2d(there, 3, 1, 1)
        mean = nn.functional.avg_pool2d(place, 3, 1, 1) / share.clamp(min=1e-6)
        place = torch.where(there > 0, place, mean * (share > 0))
        there = (share > 0).float()
    return place, there[:, 0] > 0


def _carry(source: Tensor, colours: Tensor, target: Tensor) -> Tensor:
    """Colours [N,3] at places [N,3], to places [M,3] -> [M,7]."""
    step = -(-len(source) // _MOST)
    source, colours = source[::step], colours[::step]
    scale = source.new_tensor([1, _DEPTH, 1])
    mirrored = source * source.new_tensor([-1, 1, 1])
    distance = torch.minimum(
        torch.cdist(target * scale, source * scale), torch.cdist(target * scale, mirrored * scale) + _MIRROR
    )
    near, wide = (torch.softmax(-0.5 * (distance / reach) ** 2, 1) @ colours for reach in (_NEAR, _WIDE))
    nearness = torch.exp(-distance.amin(1, keepdim=True) / _WIDE)
    return torch.cat([near, wide, nearness], 1)
