"""Mutual occlusion: avatar and scene are rasterized together, so that each hides the other where it is nearer.

Where nothing of the scene is ever in front of an avatar, drawing the avatar over the scene's picture gives the same
image, and the scene is drawn once for as long as the camera stands still.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ahoy_core.conventions import Cameras
from ahoy_core.scene.cost import Rates
from ahoy_core.scene.effects.effect import Effect, Verdict
from ahoy_core.scene.shot import NEAR, Content, in_picture
from ahoy_core.splat.constants import ALPHA_CUTOFF

# Pixels of a cell of the depth maps that are compared.
_CELL = 4
_LEVELS = 7
# Share of an avatar's cells with something in front: under it, edges of the soles on the ground at most.
_LEAST = 0.002
# Metres: nearer than this to the surface counts as touching, not as in front.
_TOUCH = 0.01
_FAINT = 0.05


def hidden_share(content: Content) -> float:
    """The largest share, over moments, of the avatars' cells in the picture that have some of the scene before them."""
    gaussians, worst = content.scene.gaussians, 0.0
    solid = gaussians.opacities > _FAINT
    for number, frame in enumerate(content.moments):
        cameras = content.shot.at(frame)
        near = _nearest(gaussians.means[solid], content.scene.covars[solid], gaussians.opacities[solid], cameras)
        hidden, cells = 0, 0
        for surface in content.surfaces:
            h, c = _behind(surface[number][0], near, cameras)
            hidden, cells = hidden + h, cells + c
        worst = max(worst, hidden / max(1, cells))
    return worst


def _nearest(means: Tensor, covars: Tensor, opacities: Tensor, cameras: Cameras) -> list[Tensor]:
    """Depth maps of the scene's nearest Gaussians, one for each octave of their radius, in cells that grow with it."""
    u, v, radius, depth = _circles(means, covars, opacities, cameras)
    octave = torch.log2((radius / _CELL).clamp(min=1)).ceil().clamp(max=_LEVELS - 1).long()
    # Three quarters of the cut-off radius hold what is visibly dense.
    maps = []
    for level in range(_LEVELS):
        size = _CELL << level
        wide, high = -(-cameras.width // size), -(-cameras.height // size)
        flat = torch.full((high * wide,), torch.inf)
        mine = (octave == level) & (depth > NEAR)
        x, y = (u[mine] / size).floor().long(), (v[mine] / size).floor().long()
        inside = (x >= 0) & (x < wide) & (y >= 0) & (y < high)
        flat.scatter_reduce_(0, y[inside] * wide + x[inside], depth[mine][inside].float(), "amin")
        maps.append(flat.view(high, wide))
    return maps


def _circles(
    means: Tensor, covars: Tensor, opacities: Tensor, cameras: Cameras
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Where Gaussians are in the picture of the first camera: u, v, radius [N] in pixels and depth [N] in metres."""
    viewmat, K = cameras.viewmats[0].to(means), cameras.Ks[0].to(means)
    camera = means @ viewmat[:3, :3].T + viewmat[:3, 3]
    depth = camera[:, 2]
    near = depth.clamp(min=NEAR)
    u, v = (K[i, i] * camera[:, i] / near + K[i, 2] for i in (0, 1))
    sigmas = (2 * torch.log((opacities / ALPHA_CUTOFF).clamp(min=1))).sqrt()
    extent = (covars.diagonal(dim1=1, dim2=2).sum(1).clamp(min=0) / 2).sqrt() * K[0, 0] / near
    return u, v, sigmas * (extent + 0.5), depth


def _behind(places: Tensor, near: list[Tensor], cameras: Cameras) -> tuple[int, int]:
    """Of an avatar's cells: those that have something nearer, and all."""
    pixels, depths = cameras.project(places)
    u, v, depth = pixels[0, :, 0], pixels[0, :, 1], depths[0]
    shown = in_picture(cameras, pixels[0], depth)
    if not bool(shown.any()):
        return 0, 0
    u, v, depth = u[shown], v[shown], depth[shown]
    covered = torch.zeros(len(u), dtype=torch.bool)
    for level, cells in enumerate(near):
        size = _CELL << level
        found = cells[(v / size).long(), (u / size).long()]
        covered |= found < depth - _TOUCH
    # The nearest surface of a cell is what is seen: a far one behind the avatar's own body hides nothing.
    wide = -(-cameras.width // _CELL)
    cell = (v / _CELL).long() * wide + (u / _CELL).long()
    front = torch.full((int(cell.max()) + 1,), torch.inf).scatter_reduce_(0, cell, depth.float(), "amin")
    own = depth <= front[cell] + 0.05
    hidden = torch.unique(cell[covered & own])
    return len(hidden), len(torch.unique(cell))


def _judge(content: Content) -> Verdict:
    if not len(content.scene) or not content.puppets:
        return Verdict(False, "there is no scene to hide behind" if content.puppets else "there is no avatar")
    share = hidden_share(content)
    evidence = {"hidden_share": round(share, 4)}
    if share > _LEAST:
        return Verdict(True, f"parts of the scene come before up to {share:.1%} of an avatar", evidence)
    if len(content.puppets) > 1:
        return Verdict(False, "nothing of the scene is before an avatar; avatars always hide each other", evidence)
    return Verdict(False, "nothing of the scene is before the avatar", evidence)


def _seconds(content: Content, verdict: Verdict, rates: Rates) -> float:
    """Of the joint pictures, which take the place of the avatars' own."""
    return content.frames * joint_seconds(content, rates)


def joint_seconds(content: Content, rates: Rates) -> float:
    """CPU-seconds of one joint picture: of all of it, or of the avatars' window before a camera that stands still."""
    if not content.shot.still:
        return rates.raster(content.avatar_load.plus(content.scene_load))
    load = content.avatar_load._replace(pixels=0.0).plus(content.scene_load_in(content.avatar_window))
    return rates.raster(load) + len(content.scene) * rates.pick + content.pixels * rates.paste


OCCLUSION = Effect(
    "occlusion",
    "scene and avatars hide each other",
    _judge,
    _seconds,
    lambda content: bool(content.puppets) and len(content.scene) > 0,
)
