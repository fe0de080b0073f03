"""Motion blur and depth of field: a frame as the mean, in linear light, of several moments and points of the lens.

Both draw on the same samples, so that having both costs no more than the one that needs more of them. Samples are
evenly spread (moments at the middles of equal intervals, points of the lens on a sunflower spiral), the same for every
frame, so that nothing flickers. Reference: the same with many samples, tests/scene/test_references.py.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ahoy_core.conventions import Cameras
from ahoy_core.motion.time import slerp
from ahoy_core.scene.cost import Rates
from ahoy_core.scene.effects.effect import Effect, Verdict
from ahoy_core.scene.shot import Content, Shot, in_picture

MOST_SAMPLES = 10
# Pixels: less blur than this is less than the rasterizer's own; between samples a gap this wide does not show.
_LEAST_BLUR, _GAP, _LENS_GAP = 1.0, 1.5, 1.0
_GOLDEN = math.pi * (3 - math.sqrt(5))


@dataclass(frozen=True)
class Sample:
    """One picture of a frame: `moment` in frames after the frame's start, and the lens's `offset` (x, y) in radii."""

    moment: float = 0.0
    offset: tuple[float, float] = (0.0, 0.0)


def samples(count: int, moving: bool, lens: bool, shutter: float) -> list[Sample]:
    """`count` samples over the open shutter, the lens, or both (then in an order that links neither to the other)."""
    made = []
    for i in range(count):
        moment = shutter * (i + 0.5) / count if moving else 0.0
        # Steps by the golden ratio visit the spiral's rings evenly in every part of the exposure.
        k = int((i * 0.6180339887 % 1) * count) if moving and lens else i
        radius = math.sqrt((k + 0.5) / count)
        # A single one stands for the whole lens: any place but its middle would only shift the picture.
        spread = lens and count > 1
        offset = (radius * math.cos(k * _GOLDEN), radius * math.sin(k * _GOLDEN)) if spread else (0.0, 0.0)
        made.append(Sample(moment, offset))
    return made


def through_lens(cameras: Cameras, offset: tuple[float, float], aperture: float, focus: float) -> Cameras:
    """A pinhole at a point of the lens, sheared so that the plane at `focus` metres stays where it is in the picture.

    Args:
        cameras: The pinhole in the middle of the lens.
        offset: x and y in radii of the lens.
        aperture: Its diameter, metres.
        focus: Metres.
    """
    dx, dy = (aperture / 2 * o for o in offset)
    viewmats, Ks = cameras.viewmats.clone(), cameras.Ks.clone()
    viewmats[:, 0, 3] -= dx
    viewmats[:, 1, 3] -= dy
    Ks[:, 0, 2] += Ks[:, 0, 0] * dx / focus
    Ks[:, 1, 2] += Ks[:, 1, 1] * dy / focus
    return Cameras(viewmats, Ks, cameras.width, cameras.height)


def focus_of(content: Content) -> float:
    """Metres to what is sharp: as the shot says, or the first avatar's middle in the first frame."""
    if content.shot.focus > 0 or not content.puppets:
        return content.shot.focus or 3.0
    places = content.surfaces[0][0][0]
    _, depths = content.shot.at(0).project(((places.amin(0) + places.amax(0)) / 2)[None])
    return max(0.1, float(depths[0, 0]))


def motion_pixels(content: Content) -> float:
    """The way, in pixels, that the parts of an avatar go while the shutter is open, all but its fastest percent."""
    worst = 0.0
    for puppet in content.puppets:
        motion = puppet.motion
        for frame in content.moments:
            other = frame + 1 if frame + 1 < len(motion) else frame - 1
            if other < 0:
                continue
            cameras = content.shot.at(frame)
            (first, depth), (second, _) = (cameras.project(p) for p, _ in puppet.surface([frame, other]))
            shown = in_picture(cameras, first[0], depth[0])
            if bool(shown.any()):
                way = (second[0] - first[0]).norm(dim=1)[shown]
                worst = max(worst, float(way.quantile(0.99)))
    return worst * content.shot.shutter


def camera_pixels(content: Content) -> float:
    """The largest way, in pixels, that things near and far go by the camera's motion in one exposure."""
    shot = content.shot
    if shot.still or len(shot.cameras) < 2:
        return 0.0
    at = focus_of(content)
    worst = 0.0
    for frame in content.moments:
        other = min(frame + 1, len(shot.cameras) - 1)
        view = torch.linalg.inv(shot.cameras.viewmats[frame])
        corners = torch.tensor(
            [[x * z, y * z, z, 1.0] for z in (0.5 * at, at, 2 * at) for x in (-0.3, 0.3) for y in (-0.3, 0.3)]
        )
        world = (corners @ view.T)[:, :3]
        first, second = (shot.at(f).project(world).pixels[0] for f in (frame, other))
        worst = max(worst, float((second - first).norm(dim=1).max()))
    return worst * shot.shutter


def lens_pixels(content: Content) -> float:
    """The largest diameter, in pixels, of the circle that a point of the scene or an avatar is blurred to."""
    shot = content.shot
    if shot.aperture <= 0:
        return 0.0
    at, worst = focus_of(content), 0.0
    cameras = shot.at(0)
    clouds = [content.scene.gaussians.means[:: max(1, len(content.scene) // 5000)]]
    clouds += [surfaces[0][0] for surfaces in content.surfaces]
    for cloud in clouds:
        pixels, depths = cameras.project(cloud)
        depth = depths[0]
        shown = in_picture(cameras, pixels[0], depth, near=0.2)
        if bool(shown.any()):
            circle = shot.aperture * float(cameras.Ks[0, 0, 0]) * (1 / depth[shown] - 1 / at).abs()
            worst = max(worst, float(circle.quantile(0.98)))
    return worst


def _needed(pixels: float, area: bool) -> int:
    """Samples so that neighbours are within a gap: along a line, or over a disc."""
    gaps = pixels / (_LENS_GAP if area else _GAP)
    return int(min(MOST_SAMPLES, max(2, math.ceil(math.pi / 4 * gaps * gaps if area else gaps))))


def _judge_motion(content: Content) -> Verdict:
    if content.shot.shutter == 0:
        return Verdict(False, "the shutter is closed at once")
    if content.frames < 2:
        return Verdict(False, "one frame does not move")
    pixels = max(motion_pixels(content), camera_pixels(content))
    evidence = {"pixels": round(pixels, 2)}
    if pixels < _LEAST_BLUR:
        return Verdict(False, f"nothing moves more than {pixels:.1f} pixels while the shutter is open", evidence)
    count = _needed(pixels, area=False)
    return Verdict(True, f"parts move up to {pixels:.1f} pixels while the shutter is open", evidence, count)


def _judge_lens(content: Content) -> Verdict:
    if content.shot.aperture == 0:
        return Verdict(False, "the lens is a pinhole")
    pixels = lens_pixels(content)
    evidence = {"pixels": round(pixels, 2), "focus_m": round(focus_of(content), 2)}
    if pixels < 2 * _LEAST_BLUR:
        return Verdict(False, f"nothing is out of focus by more than {pixels:.1f} pixels", evidence)
    count = _needed(pixels, area=True)
    return Verdict(True, f"out of focus by up to {pixels:.1f} pixels", evidence, count)


def mapping(content: Content, rates: Rates) -> float:
    """CPU-seconds of finding the Gaussians of all full avatars for one pose."""
    return rates.map * sum(puppet.avatar.map_work(puppet.body) for puppet in content.puppets)


def posing(content: Content, rates: Rates) -> float:
    """CPU-seconds of posing all avatars once, their Gaussians found."""
    return len(content.puppets) * rates.skin + content.avatar_gaussians * rates.pose


def _seconds(content: Content, verdict: Verdict, rates: Rates) -> float:
    """Of the samples beyond the first but for drawing them, which depends on the other effects (see plan.py)."""
    more = max(1, verdict.quality) - 1
    between = content.pixels * rates.blend + content.avatar_gaussians * rates.curve
    return content.frames * more * between


def _can_blur(content: Content) -> bool:
    return content.shot.shutter > 0 and content.frames > 1


MOTION_BLUR = Effect(
    "motion_blur", "what moves while the shutter is open is blurred", _judge_motion, _seconds, _can_blur
)
DEPTH_OF_FIELD = Effect(
    "depth_of_field",
    "what is out of focus is blurred",
    _judge_lens,
    _seconds,
    lambda content: content.shot.aperture > 0,
)


def between(first: Tensor, second: Tensor, share: float) -> Tensor:
    """World-to-camera matrices [4,4] between two, for the moments of a moving camera: turn by slerp, centre by line."""
    rotation = slerp(first[None, :3, :3], second[None, :3, :3], torch.tensor([share]))[0]
    centers = [-(view[:3, :3].T @ view[:3, 3]) for view in (first, second)]
    view = torch.eye(4).to(first)
    view[:3, :3] = rotation
    view[:3, 3] = -(rotation @ torch.lerp(centers[0], centers[1], share))
    return view


def shot_at(shot: Shot, frame: int, moment: float) -> Cameras:
    """The camera a share of a frame after the frame's start."""
    if shot.still or moment == 0 or frame + 1 >= len(shot.cameras):
        return shot.at(frame)
    view = between(shot.cameras.viewmats[frame], shot.cameras.viewmats[frame + 1], moment)
    return Cameras(view[None], shot.at(frame).Ks, shot.cameras.width, shot.cameras.height)
