"""Frames of avatars in a scene, I = R(D(G_t; theta_t) u G_scene; camera) of paper section 3.4, and the planned effects.

A `Stage` holds what does not change from frame to frame. Everything an effect needs is made inside that effect's own
section of the ledger, so an effect that is off has no entry, makes no tensor and calls nothing.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ahoy_core.avatar.avatar import Mapped, Posed
from ahoy_core.conventions import Cameras
from ahoy_core.formats.images import to_uint8
from ahoy_core.scene.backdrop import Backdrop, look, shaded, together, undrawn, with_avatars
from ahoy_core.scene.color import to_linear, to_srgb
from ahoy_core.scene.cost import Ledger
from ahoy_core.scene.effects import (
    ambient_occlusion,
    contact_shadow,
    foot_contact,
    light,
    sampling,
    secondary_motion,
    view_color,
)
from ahoy_core.scene.exposure import Exposure, at_moment, knots
from ahoy_core.scene.plan import BASE, Plan
from ahoy_core.scene.puppet import Points, Puppet
from ahoy_core.scene.scene import Scene
from ahoy_core.scene.shot import Content, Shot

Picture = NDArray[np.uint8]


@dataclass(frozen=True)
class _Scenery:
    """What all samples of one frame share: shadow on the scene, and backdrops that were shaded already."""

    shadow: contact_shadow.Shadow | None
    backdrops: dict[tuple[float, float], Backdrop] = field(default_factory=dict)


@dataclass
class Stage:
    """A scene, who is in it, how it is filmed, with which effects; `picture(frame)` may be called from any thread."""

    scene: Scene
    puppets: tuple[Puppet, ...]
    shot: Shot
    plan: Plan
    ledger: Ledger = field(default_factory=Ledger)

    def __post_init__(self) -> None:
        self._views: dict[tuple[float, float], Backdrop] = {}
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
        casting = [name for name in ("contact_shadow", "ambient_occlusion") if self.plan.on(name)]
        if casting:
            with self.ledger.section(casting[0]):
                self._discs = [contact_shadow.occluders(puppet) for puppet in self.puppets]
        if self.plan.on("contact_shadow"):
            with self.ledger.section("contact_shadow"):
                self._axes = contact_shadow.short_axes(self.scene.gaussians.quats, self.scene.gaussians.scales)
        if self.plan.on("ambient_occlusion"):
            with self.ledger.section("ambient_occlusion"):
                self._nearby = ambient_occlusion.surfaces_of(self.scene, *ambient_occlusion.extent(content))
        self._swings: list[secondary_motion.Swing | None] = [None] * len(self.puppets)
        if self.plan.on("secondary_motion"):
            with self.ledger.section("secondary_motion"):
                self._swings = [secondary_motion.swing_of(puppet) for puppet in self.puppets]
        self._focus = sampling.focus_of(content) if self.plan.on("depth_of_field") else 1.0
        moving, lens = self.plan.on("motion_blur"), self.plan.on("depth_of_field")
        count = self.plan.samples
        self._samples = (
            sampling.samples(count, moving, lens, self.shot.shutter) if moving or lens else [sampling.Sample()]
        )

    @torch.no_grad()
    def picture(self, frame: int) -> Picture:
        """uint8 [H,W,3] of a frame."""
        exposure, scenery = self._exposed(frame)
        total = self._sample(frame, self._samples[0], exposure, scenery, self.ledger)
        if len(self._samples) > 1:
            # The first sample is what the frame costs anyway; the others are the price of blur.
            with self.ledger.section(self._blur):
                total = to_linear(total)
                for sample in self._samples[1:]:
                    total += to_linear(self._sample(frame, sample, exposure, scenery, Ledger()))
                total = to_srgb(total / len(self._samples))
        return to_uint8(total.permute(2, 0, 1))

    @property
    def _blur(self) -> str:
        """The effect that asked for most of the samples, whose time they are."""
        return max(
            (n for n in ("motion_blur", "depth_of_field") if self.plan.on(n)), key=lambda n: self.plan[n].quality
        )

    def _exposed(self, frame: int) -> tuple[Exposure, _Scenery]:
        """A frame's avatars, posed and lit, and what they do to the scene; light and shadow are those of its middle."""
        moments = knots([sample.moment for sample in self._samples])
        middle = moments[len(moments) // 2]
        mapped = self._mapped(frame, middle)
        lit, relative = self._lit(frame, middle, self._posed(frame, middle, mapped, self.ledger))
        shadow = None
        if self.plan.on("contact_shadow"):
            with self.ledger.section("contact_shadow"):
                eye, strength = self.shot.at(frame).centers[0], self.plan.strength("contact_shadow")
                discs = contact_shadow.carried(self._discs, relative)
                shadow = contact_shadow.cast(self.scene.gaussians.means, self._axes, eye, discs, strength)
        shown = together(lit)
        posed = {middle: shown}
        for moment in moments:
            if moment != middle:
                with self.ledger.section(self._blur):
                    there = together(self._posed(frame, moment, mapped, Ledger()))
                    posed[moment] = replace(there, colors=shown.colors)
        return Exposure(moments, tuple(posed[moment] for moment in moments)), _Scenery(shadow)

    def _mapped(self, frame: int, moment: float) -> list[Mapped]:
        """Each avatar's canonical Gaussians for a pose; in an exposure poses differ too little to change them."""
        with self.ledger.section(BASE):
            poses = [at_moment(puppet.motion, frame, moment)[0] for puppet in self.puppets]
            return [p.avatar.mapped(p.body, pose) for p, pose in zip(self.puppets, poses, strict=True)]

    def _posed(self, frame: int, moment: float, mapped: list[Mapped], ledger: Ledger) -> list[Posed]:
        """Each avatar a share of a frame after a frame, in its own colours."""
        made = []
        for puppet, own, swing in zip(self.puppets, mapped, self._swings, strict=True):
            pose, transl = at_moment(puppet.motion, frame, moment)
            face = None
            if self.plan.on("expression") and puppet.motion.expression is not None:
                with ledger.section("expression"):
                    face = puppet.avatar.face_offset(puppet.body, puppet.motion.expression[frame])
            with ledger.section(BASE):
                made.append(puppet.avatar.pose(puppet.body, pose, transl, face=face, mapped=own))
            if swing is not None:
                with ledger.section("secondary_motion"):
                    made[-1] = replace(made[-1], means=swing.moved(made[-1].means, frame, moment))
        return made

    def _lit(self, frame: int, moment: float, posed: list[Posed]) -> tuple[list[Posed], list[Tensor]]:
        """The same in the scene's light, and their joints' transforms, as far as an effect needs them."""
        needing = [n for n in ("light", "ambient_occlusion", "contact_shadow") if self.plan.on(n)]
        if not needing:
            return posed, []
        with self.ledger.section(needing[0]):
            poses = [at_moment(puppet.motion, frame, moment) for puppet in self.puppets]
            relative = [p.relative(a[None], t[None])[0] for p, (a, t) in zip(self.puppets, poses, strict=True)]
        colors = [one.colors for one in posed]
        if self.plan.on("light"):
            with self.ledger.section("light"):
                strength = self.plan.strength("light")
                for i, puppet in enumerate(self.puppets):
                    _, normals = puppet.points.posed(relative[i])
                    colors[i] = light.relight(colors[i], normals, self._lights[i], strength)
        if self.plan.on("ambient_occlusion"):
            with self.ledger.section("ambient_occlusion"):
                strength, discs = self.plan.strength("ambient_occlusion"), contact_shadow.carried(self._discs, relative)
                for i, puppet in enumerate(self.puppets):
                    left = ambient_occlusion.light_left(*puppet.sample.posed(relative[i]), self._nearby, discs)
                    colors[i] = ambient_occlusion.darkened(colors[i], left, puppet, strength)
        return [replace(one, colors=own) for one, own in zip(posed, colors, strict=True)], relative

    def _sample(
        self, frame: int, sample: sampling.Sample, exposure: Exposure, scenery: _Scenery, ledger: Ledger
    ) -> Tensor:
        """One picture [H,W,3] sRGB."""
        cameras = sampling.shot_at(self.shot, frame, sample.moment)
        if sample.offset != (0.0, 0.0):
            cameras = sampling.through_lens(cameras, sample.offset, self.shot.aperture, self._focus)
        backdrop = self._backdrop(cameras, sample.offset, scenery, ledger)
        joint = self.plan.on("occlusion")
        with ledger.section("occlusion" if joint else BASE):
            return with_avatars(backdrop, exposure.at(sample.moment), joint)

    def _backdrop(self, cameras: Cameras, offset: tuple[float, float], scenery: _Scenery, ledger: Ledger) -> Backdrop:
        """The scene, in shadow where avatars cast it, before a camera."""
        if not self.shot.still:
            return self._look(cameras, scenery.shadow, ledger)
        if offset not in scenery.backdrops:
            with self._lock:
                if offset not in self._views:
                    self._views[offset] = self._look(cameras, None, ledger)
            view = self._views[offset]
            if scenery.shadow is not None:
                with ledger.section("contact_shadow"):
                    view = shaded(view, scenery.shadow, len(self.scene))
            scenery.backdrops[offset] = view
        return scenery.backdrops[offset]

    def _look(self, cameras: Cameras, shadow: contact_shadow.Shadow | None, ledger: Ledger) -> Backdrop:
        """The scene before a camera, from scratch."""
        colors = self.scene.gaussians.colors
        if self.plan.on("view_color"):
            with ledger.section("view_color"):
                colors = view_color.colors_towards(self.scene, torch.arange(len(self.scene)), cameras)
        if shadow is not None:
            with ledger.section("contact_shadow"):
                colors = colors.clone()
                colors[shadow.rows] = contact_shadow.darkened(colors[shadow.rows], shadow.light)
        with ledger.section(BASE):
            # From a moving camera the joint picture of a frame is the only one that is drawn.
            made = undrawn if self.plan.on("occlusion") and not self.shot.still else look
            return made(self.scene, colors, cameras, self.shot.background)
