"""Contact shadow: what an avatar takes of the sky's light from the surfaces round its feet.

Every scene Gaussian nearby loses the share of its hemisphere, weighted by the cosine, that the avatar covers. The
avatar is a few hundred discs carried by its joints; a disc facing a point covers A cos cos / (pi d² + A) of it
(Bunnell, Dynamic Ambient Occlusion and Indirect Lighting, GPU Gems 2), and only those facing it count: of a closed body
that is its outline, once. Reference: ray casting, tests/scene/test_references.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from ahoy_core.conventions import Cameras
from ahoy_core.scene.color import to_linear, to_srgb
from ahoy_core.scene.cost import Rates
from ahoy_core.scene.effects.effect import Effect, Verdict
from ahoy_core.scene.puppet import Points, Puppet
from ahoy_core.scene.shot import Content, in_picture
from ahoy_core.splat import Window, hull
from ahoy_core.splat.gaussians import quats_to_rotations

_STRATA = ((0.06, 110), (0.2, 70), (0.6, 70), (3.0, 70))
"""Heights in the canonical pose, metres, and how many discs stand for the body up to each."""
OCCLUDERS = sum(count for _, count in _STRATA)
REACH = 0.9
"""Metres from an avatar's nearest part beyond which its shadow is under 2% and left out."""
_AT_ONCE = 512  # receivers
_LEAST_TAKEN = 1 / 256  # of the light: sRGB changes by a 2.4th of the share at most, here by less than half a step
_MOST_LIFT = 0.3  # metres: a body higher than this over the ground has no contact to show
_LEAST_PIXELS = 6  # height in pixels of the shadow's reach on the ground, under which nobody sees it


class Discs(NamedTuple):
    """D discs in the world: places [D,3], unit normals [D,3], areas [D] m²."""

    places: Tensor
    facing: Tensor
    areas: Tensor


@dataclass(frozen=True)
class Shadow:
    """Which Gaussians of a scene [K] are darker by it, and the share of light [K] that is left to each."""

    rows: Tensor
    light: Tensor


def occluders(puppet: Puppet) -> Points:
    """An avatar as discs with all of its area, smaller ones near the ground, where a shadow shows each of them."""
    points = puppet.points
    height = points.means[:, 2] - points.means[:, 2].min()
    chosen, areas, low = [], [], -1.0
    for high, count in _STRATA:
        rows = torch.nonzero((height > low) & (height <= high))[:, 0]
        low = high
        if len(rows):
            some = rows[torch.linspace(0, len(rows) - 1, min(count, len(rows))).round().long()]
            chosen.append(some)
            areas.append(points.areas[some] * (points.areas[rows].sum() / points.areas[some].sum().clamp(min=1e-12)))
    picked = points[torch.cat(chosen)]
    return Points(picked.means, picked.normals, torch.cat(areas), picked.lbs_weights)


def short_axes(quats: Tensor, scales: Tensor) -> Tensor:
    """[N,3]: the direction in which Gaussians are thinnest, which is their surface's normal but for the sign.

    Args:
        quats: [N,4] wxyz.
        scales: [N,3].
    """
    axes = quats_to_rotations(quats)
    return axes.gather(2, scales.argmin(1)[:, None, None].expand(-1, 3, 1))[:, :, 0]


def carried(discs: list[Points], relative: list[Tensor]) -> Discs:
    """All avatars' discs in a frame, each set under its joints' transforms [J,4,4]."""
    posed = [points.posed(one) for points, one in zip(discs, relative, strict=True)]
    areas = torch.cat([points.areas for points in discs])
    return Discs(torch.cat([p for p, _ in posed]), torch.cat([n for _, n in posed]), areas)


def sky_share(points: Tensor, normals: Tensor, discs: Discs, dark: Tensor | None = None) -> Tensor:
    """The share [R] of each point's light that discs let through.

    Args:
        points: [R,3] receivers.
        normals: [R,3] theirs.
        discs: D discs.
        dark: [D] the share of the covered light that each takes; all of it by default.
    """
    if not len(points):
        return points.new_ones(0)
    parts = zip(points.split(_AT_ONCE), normals.split(_AT_ONCE), strict=True)
    return torch.cat([_share(p, n, discs, dark) for p, n in parts])


def _share(points: Tensor, normals: Tensor, discs: Discs, dark: Tensor | None) -> Tensor:
    # Squares and products by matrix multiplication: a few [R,D] arrays, which stay in the cache.
    places, facing, areas = discs
    square = torch.cdist(points, places).square_().clamp_(min=1e-8)
    inverse = square.rsqrt()
    at_point = (normals @ places.T - (normals * points).sum(1, keepdim=True)).mul_(inverse).clamp_(min=0)
    at_disc = ((facing * places).sum(1) - points @ facing.T).neg_().mul_(inverse).clamp_(min=0)
    covered = at_point.mul_(at_disc).mul_(areas).div_(square.mul_(torch.pi).add_(areas))
    taken = covered.sum(1) if dark is None else covered @ dark
    return (1 - taken).clamp(min=0)


def cast(means: Tensor, axes: Tensor, eye: Tensor, discs: Discs, strength: float = 1.0) -> Shadow:
    """The shadow of avatars on a scene; light that they take by less than half a step of 8 bits is not counted.

    Args:
        means: [N,3] the scene's Gaussians.
        axes: [N,3] theirs (`short_axes`).
        eye: [3] from where they are seen, which tells front from back.
        discs: The avatars.
        strength: 1 for the share of light that is taken; less for a lighter shadow.
    """
    low, high = discs.places.amin(0) - REACH, discs.places.amax(0) + REACH
    rows = torch.nonzero(((means > low) & (means < high)).all(1))[:, 0]
    near, normals = means[rows], axes[rows]
    normals = torch.where(((eye - near) * normals).sum(1, keepdim=True) < 0, -normals, normals)
    light = 1 - strength * (1 - sky_share(near, normals, discs))
    dark = light < 1 - _LEAST_TAKEN
    return Shadow(rows[dark], light[dark])


def darkened(colors: Tensor, light: Tensor) -> Tensor:
    """Colours [K,3] sRGB with a share [K] of their light."""
    return to_srgb(to_linear(colors) * light[:, None])


def _judge(content: Content) -> Verdict:
    if content.scene.ground is None or not content.puppets:
        return Verdict(False, "no ground was found" if content.puppets else "there is no avatar")
    pixels, lift, count = 0.0, float("inf"), 0
    for surfaces in content.surfaces:
        for (places, _), frame in zip(surfaces, content.moments, strict=True):
            lift = min(lift, float(places[:, 2].min()))
            seen, below = _ground_in_view(content, places, content.shot.at(frame))
            pixels, count = max(pixels, seen), max(count, below)
    evidence = {"height_m": round(lift, 3), "pixels": round(pixels, 1), "receivers": float(count)}
    if lift > _MOST_LIFT:
        return Verdict(False, f"the avatar is never less than {lift:.2f} m over the ground", evidence)
    if pixels < _LEAST_PIXELS or not count:
        return Verdict(False, "no ground near the avatar is in the picture", evidence)
    return Verdict(
        True, f"feet come within {max(0.0, lift):.2f} m of ground that is in the picture", evidence, OCCLUDERS
    )


def _ground_in_view(content: Content, places: Tensor, cameras: Cameras) -> tuple[float, int]:
    """Height in pixels of the ground round the lowest part, as far as it is in the picture, and Gaussians there."""
    foot = places[places[:, 2].argmin()]
    steps = torch.linspace(-0.5, 0.5, 9)
    grid = torch.stack([p.reshape(-1) for p in (*torch.meshgrid(steps, steps, indexing="ij"), torch.zeros(9, 9))], 1)
    pixels, depths = cameras.project(grid + foot * torch.tensor([1.0, 1.0, 0.0]))
    v = pixels[0, :, 1]
    shown = in_picture(cameras, pixels[0], depths[0])
    if not bool(shown.any()):
        return 0.0, 0
    offset = content.scene.gaussians.means - foot * torch.tensor([1.0, 1.0, 0.0])
    below = (offset[:, :2].abs() < 0.5).all(1) & (offset[:, 2].abs() < 0.1)
    return float(v[shown].max() - v[shown].min()), int(below.sum())


def _seconds(content: Content, verdict: Verdict, rates: Rates) -> float:
    """Of the shadow, and of drawing the scene again where it is (a moving camera draws it anyway)."""
    near = 0
    for surfaces in content.surfaces:
        places = surfaces[len(surfaces) // 2][0]
        inside = (content.scene.gaussians.means > places.amin(0) - REACH).all(1)
        near += int((inside & (content.scene.gaussians.means < places.amax(0) + REACH).all(1)).sum())
    discs = OCCLUDERS * len(content.puppets)
    frame = near * (discs * rates.pair + rates.shade) + len(content.scene) * rates.pick
    return content.frames * (frame + len(content.puppets) * rates.joints + redraw_seconds(content, rates))


def redraw_seconds(content: Content, rates: Rates) -> float:
    """CPU-seconds of drawing the scene once again where shadows are."""
    if not content.shot.still:
        return 0.0
    load = content.scene_load_in(_window(content))
    return rates.raster(load) + len(content.scene) * rates.pick + content.pixels * rates.paste


def _window(content: Content) -> Window | None:
    """Where a shadow shows at a middle moment, found with every sixth disc and every fourth Gaussian."""
    frame = content.moments[len(content.moments) // 2]
    gaussians, cameras = content.scene.gaussians, content.shot.at(frame)
    rows = torch.arange(0, len(content.scene), 4)
    discs, relative = [], []
    for puppet in content.puppets:
        some = occluders(puppet)
        some = some[torch.arange(0, len(some), 6)]
        discs.append(Points(some.means, some.normals, 6 * some.areas, some.lbs_weights))
        relative.append(puppet.relative(puppet.motion.pose[[frame]], puppet.motion.transl[[frame]])[0])
    axes = short_axes(gaussians.quats[rows], gaussians.scales[rows])
    shadow = cast(gaussians.means[rows], axes, cameras.centers[0], carried(discs, relative))
    return hull(content.scene_boxes[rows][shadow.rows])


CONTACT_SHADOW = Effect(
    "contact_shadow",
    "avatars darken the ground they stand on",
    _judge,
    _seconds,
    lambda content: bool(content.puppets) and len(content.scene) > 0,
)
