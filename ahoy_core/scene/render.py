"""Frames of avatars in a scene, I = R(D(G_t; theta_t) u G_scene; camera) of paper section 3.4, and the planned effects.

A `Stage` holds what does not change from frame to frame. Everything an effect needs is made inside that effect's own
section of the ledger, so an effect that is off has no entry, makes no tensor and calls nothing.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ahoy_core.avatar.avatar import Posed
from ahoy_core.body.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from ahoy_core.conventions import Cameras
from ahoy_core.formats.images import to_uint8
from ahoy_core.motion.time import slerp
from ahoy_core.scene.color import to_linear, to_srgb
from ahoy_core.scene.cost import Ledger, rasterize
from ahoy_core.scene.effects import contact_shadow, foot_contact, light, sampling, view_color
from ahoy_core.scene.plan import BASE, Plan
from ahoy_core.scene.puppet import Points, Puppet
from ahoy_core.scene.scene import Scene
from ahoy_core.scene.shot import Content, Shot

Picture = NDArray[np.uint8]


@dataclass(frozen=True)
class SceneView:
    """A scene before one camera: rows of the Gaussians that can be seen, their colours, and its picture alone."""

    rows: Tensor
    means: Tensor
    covars: Tensor
    opacities: Tensor
    colors: Tensor
    image: Tensor
    alpha: Tensor
    receivers: contact_shadow.Receivers | None = None


@dataclass
class Stage:
    """A scene, who is in it, how it is filmed, with which effects; `picture(frame)` may be called from any thread."""

    scene: Scene
    puppets: tuple[Puppet, ...]
    shot: Shot
    plan: Plan
    ledger: Ledger = field(default_factory=Ledger)

    def __post_init__(self) -> None:
        self._views: dict[tuple[float, float], SceneView] = {}
        self._lock = threading.Lock()
        if self.plan.on("foot_contact"):
            with self.ledger.section("foot_contact"):
                self.puppets = tuple(foot_contact.corrected(puppet) for puppet in self.puppets)
        content = Content(self.scene, self.puppets, self.shot)
        self._lights: list[Tensor] = []
        if self.plan.on("light"):
            with self.ledger.section("light"):
                around = [light.surroundings(self.scene, light.chest(content, i)) for i in range(len(self.puppets))]
                self._lights = [light.irradiance(linear) for linear, _ in around]
        self._discs: list[Points] = []
        if self.plan.on("contact_shadow"):
            with self.ledger.section("contact_shadow"):
                self._discs = [contact_shadow.occluders(puppet) for puppet in self.puppets]
        self._focus = sampling.focus_of(content) if self.plan.on("depth_of_field") else 1.0
        moving, lens = self.plan.on("motion_blur"), self.plan.on("depth_of_field")
        count = self.plan.samples
        self._samples = (
            sampling.samples(count, moving, lens, self.shot.shutter) if moving or lens else [sampling.Sample()]
        )

    @torch.no_grad()
    def picture(self, frame: int) -> Picture:
        """uint8 [H,W,3] of a frame."""
        if len(self._samples) == 1:
            return to_uint8(self._sample(frame, self._samples[0], None).permute(2, 0, 1))
        total = self._sample(frame, self._samples[0], None)
        # The first sample is what the frame costs anyway; the others are the price of blur.
        blur = ("motion_blur", "depth_of_field")
        name = max((n for n in blur if self.plan.on(n)), key=lambda n: self.plan[n].quality)
        with self.ledger.section(name):
            total = to_linear(total)
            for sample in self._samples[1:]:
                total += to_linear(self._sample(frame, sample, name))
            total = to_srgb(total / len(self._samples))
        return to_uint8(total.permute(2, 0, 1))

    def _sample(self, frame: int, sample: sampling.Sample, inside: str | None) -> Tensor:
        """One picture [H,W,3] sRGB; `inside` names the effect that asked for it, whose time its parts are then."""
        ledger = self.ledger if inside is None else Ledger()
        cameras = sampling.shot_at(self.shot, frame, sample.moment)
        if sample.offset != (0.0, 0.0):
            cameras = sampling.through_lens(cameras, sample.offset, self.shot.aperture, self._focus)
        posed: list[Posed] = []
        relative: list[Tensor] = []
        for number, puppet in enumerate(self.puppets):
            one, joints = self._posed(number, puppet, frame, sample.moment, ledger)
            posed.append(one)
            relative += [] if joints is None else [joints]
        return self._composed(posed, relative, cameras, sample.offset, ledger)

    def _posed(
        self, number: int, puppet: Puppet, frame: int, moment: float, ledger: Ledger
    ) -> tuple[Posed, Tensor | None]:
        motion = puppet.motion
        pose, transl = motion.pose[frame], motion.transl[frame]
        if moment > 0 and len(motion) > 1:
            pose, transl = _between(puppet, frame, moment)
        face = None
        if self.plan.on("expression") and motion.expression is not None:
            with ledger.section("expression"):
                face = puppet.avatar.face_offset(puppet.body, motion.expression[frame])
        with ledger.section(BASE):
            posed = puppet.avatar.pose(puppet.body, pose, transl, face=face)
        relative = None
        if self.plan.on("light") or self.plan.on("contact_shadow"):
            with ledger.section("light" if self.plan.on("light") else "contact_shadow"):
                relative = puppet.relative(pose[None], transl[None])[0]
        if self.plan.on("light") and relative is not None:
            with ledger.section("light"):
                _, normals = puppet.points.posed(relative)
                lit = light.relight(posed.colors, normals, self._lights[number], self.plan.strength("light"))
                posed = replace(posed, colors=lit)
        return posed, relative

    def _composed(
        self,
        posed: Sequence[Posed],
        relative: Sequence[Tensor],
        cameras: Cameras,
        offset: tuple[float, float],
        ledger: Ledger,
    ) -> Tensor:
        avatars = _joined(posed)
        if not len(self.scene):
            return self._over(avatars, None, cameras, ledger)
        view = self._view(cameras, offset, ledger)
        if self.plan.on("contact_shadow"):
            view = self._shaded(view, relative, cameras, ledger)
        if not self.plan.on("occlusion"):
            return self._over(avatars, view, cameras, ledger)
        with ledger.section("occlusion"):
            means, covars = torch.cat([avatars.means, view.means]), torch.cat([avatars.covars, view.covars])
            opacities, colors = torch.cat([avatars.opacities, view.opacities]), torch.cat([avatars.colors, view.colors])
            image, alpha, _ = rasterize(means, covars, opacities, colors, cameras)
            return image[0] + self.shot.background * (1 - alpha[0])

    def _shaded(self, view: SceneView, relative: Sequence[Tensor], cameras: Cameras, ledger: Ledger) -> SceneView:
        """The scene with the avatars' shadows, drawn again if its picture is needed."""
        with ledger.section("contact_shadow"):
            to = view.receivers
            if to is None:
                to = contact_shadow.receivers(self.scene.gaussians, view.rows, cameras.centers[0])
            strength = self.plan.strength("contact_shadow")
            colors = contact_shadow.shade(view.colors, to, self._discs, list(relative), strength)
            if colors is view.colors or self.plan.on("occlusion"):
                return replace(view, colors=colors)
            image, alpha, _ = rasterize(view.means, view.covars, view.opacities, colors, cameras)
            return replace(view, colors=colors, image=image[0], alpha=alpha[0])

    def _over(self, avatars: Posed, view: SceneView | None, cameras: Cameras, ledger: Ledger) -> Tensor:
        """The avatars over the scene's own picture."""
        with ledger.section(BASE):
            behind: Tensor | float = self.shot.background
            if view is not None:
                behind = view.image + self.shot.background * (1 - view.alpha)
            image, alpha, _ = rasterize(avatars.means, avatars.covars, avatars.opacities, avatars.colors, cameras)
            return image[0] + behind * (1 - alpha[0])

    def _view(self, cameras: Cameras, offset: tuple[float, float], ledger: Ledger) -> SceneView:
        """The scene before a camera; made once for each place of a camera that stands still."""
        if not self.shot.still:
            return self._look(cameras, ledger)
        with self._lock:
            if offset not in self._views:
                view = self._look(cameras, ledger)
                if self.plan.on("contact_shadow"):
                    with ledger.section("contact_shadow"):
                        eye = cameras.centers[0]
                        view = replace(view, receivers=contact_shadow.receivers(self.scene.gaussians, view.rows, eye))
                self._views[offset] = view
            return self._views[offset]

    def _look(self, cameras: Cameras, ledger: Ledger) -> SceneView:
        gaussians, covars, colors = self.scene.gaussians, self.scene.covars, self.scene.gaussians.colors
        rows = torch.arange(len(self.scene))
        if self.plan.on("view_color"):
            with ledger.section("view_color"):
                colors = view_color.colors_towards(self.scene, rows, cameras)
        with ledger.section(BASE):
            if self.plan.on("occlusion") and not self.shot.still:
                # The joint picture of this frame is the only one that will be drawn from here.
                nothing = torch.zeros(0)
                return SceneView(rows, gaussians.means, covars, gaussians.opacities, colors, nothing, nothing)
            image, alpha, radii = rasterize(gaussians.means, covars, gaussians.opacities, colors, cameras)
            # What no ray of this camera meets changes no picture: it is left out from here on.
            rows = torch.nonzero((radii[0] > 0).all(1))[:, 0]
            kept = (gaussians.means[rows], covars[rows], gaussians.opacities[rows], colors[rows])
            return SceneView(rows, *kept, image[0], alpha[0])


def _joined(posed: Sequence[Posed]) -> Posed:
    if len(posed) == 1:
        return posed[0]
    if not posed:
        return Posed(torch.zeros(0, 3), torch.zeros(0, 3, 3), torch.zeros(0, 3), torch.zeros(0))
    return Posed(*(torch.cat([getattr(one, f) for one in posed]) for f in ("means", "covars", "colors", "opacities")))


def _between(puppet: Puppet, frame: int, moment: float) -> tuple[Tensor, Tensor]:
    """Pose and translation a share of a frame after a frame; after the last one, motion goes on as it came."""
    motion, other, share = puppet.motion, frame + 1, moment
    if other >= len(motion):
        frame, other, share = frame - 1, frame, 1 + moment
    first, second = axis_angle_to_matrix(motion.pose[[frame, other]])
    pose = matrix_to_axis_angle(slerp(first, second, torch.full((len(first),), share)))
    return pose, torch.lerp(motion.transl[frame], motion.transl[other], share)
