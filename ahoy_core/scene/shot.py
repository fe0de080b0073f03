"""How a scene is filmed, and what a planner looks at: the scene, who is in it, and the camera, at a few moments."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from ahoy_core.conventions import GREY, Cameras
from ahoy_core.scene.cost import RasterLoad, box_load, raster_load
from ahoy_core.scene.puppet import Puppet
from ahoy_core.scene.scene import Scene
from ahoy_core.splat import Window, footprints, hull

# Moments that the planner looks at: enough for a walk to show every phase of a step.
_MOMENTS = 6
_REACH = 6.0  # pixels that Gaussians reach beyond their middles
NEAR = 0.05  # metres: what is nearer to a camera is not in its picture


@dataclass(frozen=True)
class Shot:
    """A camera over time.

    Attributes:
        cameras: One that stands still, or one a frame.
        fps: Frames per second.
        shutter: Share of a frame's time that the shutter is open, in [0,1]; 0 freezes motion.
        aperture: Diameter of the lens, metres; 0 is a pinhole, in which all is sharp.
        focus: Metres along the axis to what is sharp; 0 for the first avatar.
        background: Grey level behind everything.
    """

    cameras: Cameras
    fps: float = 24.0
    shutter: float = 0.5
    aperture: float = 0.0
    focus: float = 0.0
    background: float = GREY

    def __post_init__(self) -> None:
        if not (0 <= self.shutter <= 1 and self.aperture >= 0 and self.focus >= 0 and self.fps > 0):
            raise ValueError(
                f"expected shutter in [0,1], aperture and focus >= 0 and a positive rate, got {self.shutter}, "
                f"{self.aperture}, {self.focus} and {self.fps}"
            )
        if self.cameras.camera_model != "pinhole":
            raise ValueError("expected a pinhole camera; an orthographic one has no perspective to put a person into")

    @property
    def still(self) -> bool:
        """Whether the camera stands still."""
        return len(self.cameras) == 1

    def at(self, frame: int) -> Cameras:
        """The camera of a frame."""
        return self.cameras[0 if self.still else frame]


@dataclass(frozen=True)
class Content:
    """Everything the planner looks at. What costs anything to find out is found out once, when first asked for."""

    scene: Scene
    puppets: tuple[Puppet, ...]
    shot: Shot

    def __post_init__(self) -> None:
        lengths = {len(puppet.motion) for puppet in self.puppets} | (
            set() if self.shot.still else {len(self.shot.cameras)}
        )
        if len(lengths) > 1:
            raise ValueError(f"expected motions and cameras of one length, got {sorted(lengths)}; cut them alike")

    @property
    def frames(self) -> int:
        """T."""
        return len(self.puppets[0].motion) if self.puppets else len(self.shot.cameras)

    @cached_property
    def moments(self) -> list[int]:
        """Frames that are looked at, evenly spread, the first and the last among them."""
        count = min(_MOMENTS, self.frames)
        return sorted({round(i * (self.frames - 1) / max(1, count - 1)) for i in range(count)})

    @cached_property
    def surfaces(self) -> list[list[tuple[Tensor, Tensor]]]:
        """For each avatar, at each moment: surface positions and normals [M,3]."""
        return [puppet.surface(self.moments) for puppet in self.puppets]

    @cached_property
    def avatar_load(self) -> RasterLoad:
        """Of rendering the avatars alone, at a middle moment."""
        return _sum([self._one_avatar(puppet) for puppet in self.puppets], self.pixels)

    def _one_avatar(self, puppet: Puppet) -> RasterLoad:
        frame = self.moments[len(self.moments) // 2]
        relative = puppet.relative(puppet.motion.pose[[frame]], puppet.motion.transl[[frame]])[0]
        places, _ = puppet.sample.posed(relative)
        step = len(puppet.avatar) / max(1, len(places))
        rows = torch.arange(0, len(puppet.avatar), max(1, math.ceil(step)))[: len(places)]
        covars, opacities = puppet.avatar.covars[rows], puppet.avatar.opacities[rows]
        part = raster_load(places[: len(rows)], covars, opacities, self.shot.at(frame))
        factor = len(puppet.avatar) / max(1, len(rows))
        return RasterLoad(factor * part.gaussians, factor * part.visible, factor * part.intersections, part.pixels)

    @cached_property
    def scene_boxes(self) -> Tensor:
        """[N,4] the pixels that each Gaussian of the scene can change, at the first moment."""
        cameras, gaussians = self.shot.at(self.moments[0]), self.scene.gaussians
        view, K = cameras.viewmats.contiguous(), cameras.Ks.contiguous()
        parts = gaussians.means, self.scene.covars, gaussians.opacities
        return footprints(*parts, view, K, cameras.width, cameras.height)[0]

    @cached_property
    def scene_load(self) -> RasterLoad:
        """Of rendering the scene alone."""
        cameras = self.shot.cameras
        return box_load(self.scene_boxes, len(self.scene), (0, 0, cameras.width, cameras.height), picked=False)

    def scene_load_in(self, window: Window | None) -> RasterLoad:
        """Of rendering the scene into a part of the picture of a camera that stands still."""
        return RasterLoad(0, 0, 0, 0) if window is None else box_load(self.scene_boxes, 0, window, picked=True)

    @cached_property
    def avatar_window(self) -> Window | None:
        """The part of the picture that avatars can change, at the moment when it is of middling size."""
        found = []
        for number, frame in enumerate(self.moments):
            cameras = self.shot.at(frame)
            corners = []
            for surfaces in self.surfaces:
                pixels, depths = cameras.project(surfaces[number][0])
                corners.append(pixels[0][depths[0] > NEAR])
            found.append(_window_of(torch.cat(corners) if corners else torch.zeros(0, 2), cameras))
        return sorted(found, key=lambda w: 0 if w is None else w[2] * w[3])[len(found) // 2]

    @property
    def pixels(self) -> float:
        """Of one picture."""
        return float(self.shot.cameras.width * self.shot.cameras.height)

    @property
    def avatar_gaussians(self) -> int:
        """Of all avatars together."""
        return sum(len(puppet.avatar) for puppet in self.puppets)


def in_picture(cameras: Cameras, pixels: Tensor, depths: Tensor, near: float = NEAR) -> Tensor:
    """Which [N] of the points that `Cameras.project` put at pixels [N,2] and depths [N] are in the picture.

    Args:
        cameras: Their size counts.
        pixels: [N,2].
        depths: [N] metres.
        near: What is nearer to the camera is not in the picture, metres.
    """
    u, v = pixels.unbind(1)
    return (depths > near) & (u >= 0) & (u < cameras.width) & (v >= 0) & (v < cameras.height)


def _window_of(pixels: Tensor, cameras: Cameras) -> Window | None:
    """Round points [M,2] with the reach of the Gaussians on them."""
    side = torch.tensor([cameras.width, cameras.height] * 2)
    boxes = torch.cat([pixels - _REACH, pixels + _REACH], 1).clamp(min=0).minimum(side)
    return hull(boxes.round())


def _sum(loads: Sequence[RasterLoad], pixels: float) -> RasterLoad:
    total = RasterLoad(0, 0, 0, pixels)
    for load in loads:
        total = total.plus(load)
    return total
