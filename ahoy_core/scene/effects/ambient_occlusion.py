"""Ambient occlusion at contact: the light that an avatar no longer gets from surfaces beside it, as it shades them.

The counterpart of the contact shadow. Surfaces of the scene within reach are discs; each covers a share of an avatar's
hemisphere (the formula of `contact_shadow`), and what comes from there is less by the share of its sky that the avatar
took. Surroundings are taken as equally bright, and the avatar's own limbs as no obstacle between. Reference: ray
casting, tests/scene/test_ambient_occlusion.py.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ahoy_core.scene.color import to_linear, to_srgb
from ahoy_core.scene.cost import Rates
from ahoy_core.scene.effects.contact_shadow import OCCLUDERS, Discs, carried, occluders, short_axes, sky_share
from ahoy_core.scene.effects.effect import Effect, Verdict
from ahoy_core.scene.puppet import SAMPLE, Points, Puppet
from ahoy_core.scene.scene import Scene
from ahoy_core.scene.shot import Content, in_picture

REACH = 0.5
"""Metres from an avatar within which surfaces are looked at; further ones are hardly in its shadow."""
_PITCH = 0.05  # metres of a cell whose Gaussians make one disc
_FAINT = 0.3
_LEAST_LOSS = 0.02  # of the light: under one step of 8 bits in sRGB
_LEAST_SHARE = 0.01  # of the points in the picture
_LEAST_PIXELS = 40  # height of an avatar in the picture under which its shoes are a few pixels


def surfaces_of(scene: Scene, low: Tensor, high: Tensor) -> Points:
    """A scene's surfaces between two corners [3] as discs, one a cell; skinning weights are empty.

    A plane with unit normal n meets (|nx| + |ny| + |nz|) cells a pitch² of its area, hence the area of each.
    """
    g = scene.gaussians
    rows = torch.nonzero(((g.means > low) & (g.means < high)).all(1) & (g.opacities > _FAINT))[:, 0]
    means, axes = g.means[rows], short_axes(g.quats[rows], g.scales[rows])
    cells, member, counts = torch.unique(
        (means / _PITCH).floor().long(), dim=0, return_inverse=True, return_counts=True
    )
    first = torch.zeros(len(cells), dtype=torch.long)
    first[member] = torch.arange(len(rows))
    axes = axes * torch.sign((axes * axes[first[member]]).sum(1, keepdim=True))
    place, normal = (torch.zeros(len(cells), 3).index_add_(0, member, x) / counts[:, None] for x in (means, axes))
    normal = torch.nn.functional.normalize(normal, dim=1)
    areas = _PITCH**2 / normal.abs().sum(1).clamp(min=1e-6)
    return Points(place, normal, areas, torch.zeros(len(cells), 0))


def light_left(points: Tensor, normals: Tensor, nearby: Points, discs: Discs) -> Tensor:
    """The share [M] of its light that is left to each point of an avatar.

    Args:
        points: [M,3] of one avatar.
        normals: [M,3] outward.
        nearby: The scene's surfaces.
        discs: All that casts shadows on these surfaces.
    """
    low, high = points.amin(0) - REACH, points.amax(0) + REACH
    some = nearby[torch.nonzero(((nearby.means > low) & (nearby.means < high)).all(1))[:, 0]]
    if not len(some):
        return points.new_ones(len(points))
    towards = (low + high) / 2 - some.means
    facing = torch.where((towards * some.normals).sum(1, keepdim=True) < 0, -some.normals, some.normals)
    taken = 1 - sky_share(some.means, facing, discs)
    dark = taken > _LEAST_LOSS
    # A disc that lost half of its light is half a disc that covers.
    return sky_share(points, normals, Discs(some.means[dark], facing[dark], some.areas[dark]), taken[dark])


def darkened(colors: Tensor, left: Tensor, puppet: Puppet, strength: float) -> Tensor:
    """Colours [N,3] sRGB of an avatar whose sampled points have a share [M] of their light."""
    light = 1 - strength * (1 - puppet.spread(left))
    return to_srgb(to_linear(colors) * light[:, None])


def extent(content: Content) -> tuple[Tensor, Tensor]:
    """Corners [3] of what avatars come near to at the moments that are looked at, with half a step in between."""
    places = torch.cat([place for surfaces in content.surfaces for place, _ in surfaces])
    return places.amin(0) - REACH - 0.3, places.amax(0) + REACH + 0.3


def _judge(content: Content) -> Verdict:
    if not len(content.scene) or not content.puppets:
        return Verdict(False, "there is no scene to touch" if content.puppets else "there is no avatar")
    nearby = surfaces_of(content.scene, *extent(content))
    number = len(content.moments) // 2
    frame, cameras = content.moments[number], content.shot.at(content.moments[number])
    worst, share, tall = 0.0, 0.0, 0.0
    for puppet, surfaces in zip(content.puppets, content.surfaces, strict=True):
        points, normals = surfaces[number]
        pixels, depths = cameras.project(points)
        shown = in_picture(cameras, pixels[0], depths[0])
        shown &= ((cameras.centers[0] - points) * normals).sum(1) > 0
        if not bool(shown.any()):
            continue
        relative = puppet.relative(puppet.motion.pose[[frame]], puppet.motion.transl[[frame]])[0]
        loss = 1 - light_left(points, normals, nearby, carried([occluders(puppet)], [relative]))[shown]
        worst, share = max(worst, float(loss.max())), max(share, float((loss > _LEAST_LOSS).float().mean()))
        tall = max(tall, float(pixels[0, shown, 1].max() - pixels[0, shown, 1].min()))
    evidence = {"most_taken": round(worst, 3), "share": round(share, 4), "pixels": round(tall, 1)}
    if share < _LEAST_SHARE:
        return Verdict(False, "no part that is in the picture is close to a surface that the avatar shades", evidence)
    if tall < _LEAST_PIXELS:
        return Verdict(False, f"the avatar is {tall:.0f} pixels high: nobody sees its shoes", evidence)
    return Verdict(True, f"up to {worst:.0%} of the light is lost next to surfaces in the avatar's shadow", evidence)


def _seconds(content: Content, verdict: Verdict, rates: Rates) -> float:
    once = len(content.scene) * rates.shade + 3 * content.avatar_gaussians * rates.carry
    frame = 0.0
    for puppet in content.puppets:
        # Cells of the ground within reach, of which a third is dark enough to count.
        cells = min(len(content.scene), int((2 * REACH / _PITCH) ** 2))
        sampled = min(SAMPLE, len(puppet.avatar))
        frame += cells * (OCCLUDERS + sampled / 3) * rates.pair + rates.joints
        frame += len(puppet.avatar) * rates.shade + sampled * rates.carry
    return once + content.frames * frame


AMBIENT_OCCLUSION = Effect(
    "ambient_occlusion",
    "avatars darken where they touch",
    _judge,
    _seconds,
    lambda content: bool(content.puppets) and len(content.scene) > 0,
)
