"""What a scene calls for: each effect on or off, why, and what it will cost. Pure: it renders no picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

from ahoy_core.scene.cost import Rates
from ahoy_core.scene.effects.ambient_occlusion import AMBIENT_OCCLUSION
from ahoy_core.scene.effects.contact_shadow import CONTACT_SHADOW, redraw_seconds
from ahoy_core.scene.effects.effect import Effect, Verdict
from ahoy_core.scene.effects.expression import EXPRESSION
from ahoy_core.scene.effects.foot_contact import FOOT_CONTACT
from ahoy_core.scene.effects.light import LIGHT
from ahoy_core.scene.effects.occlusion import OCCLUSION, joint_seconds
from ahoy_core.scene.effects.sampling import DEPTH_OF_FIELD, MOTION_BLUR, mapping, posing
from ahoy_core.scene.effects.secondary_motion import SECONDARY_MOTION
from ahoy_core.scene.effects.view_color import VIEW_COLOR
from ahoy_core.scene.exposure import KNOTS
from ahoy_core.scene.puppet import Puppet
from ahoy_core.scene.scene import Scene
from ahoy_core.scene.shot import Content, Shot

EFFECTS: tuple[Effect, ...] = (
    FOOT_CONTACT,
    SECONDARY_MOTION,
    EXPRESSION,
    LIGHT,
    AMBIENT_OCCLUSION,
    VIEW_COLOR,
    CONTACT_SHADOW,
    OCCLUSION,
    DEPTH_OF_FIELD,
    MOTION_BLUR,
)
"""In the order in which they are applied: motion, face, colours, shadows, compositing, then samples over all of it."""
EFFECT_NAMES = tuple(effect.name for effect in EFFECTS)
BASE = "base"
STRENGTHS: Mapping[str, float] = {"light": 0.6, "ambient_occlusion": 1.0, "contact_shadow": 1.0}
"""Knobs in [0,1] and their defaults. Light is held back, as what an avatar was filmed under is a guess."""


@dataclass(frozen=True)
class Request:
    """What the user asks for.

    Attributes:
        effects: "auto" (what is called for), "all" (what is possible), "none", or names.
        rates: Of this machine (`cost.calibrate`).
        strengths: Knobs in [0,1] of effects that have one, see `STRENGTHS`.
    """

    effects: Literal["auto", "all", "none"] | Sequence[str] = "auto"
    rates: Rates = field(default_factory=Rates)
    strengths: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        names = [] if self.effects in ("auto", "all", "none") else list(self.effects)
        unknown = sorted(set(names) - set(EFFECT_NAMES)) + sorted(set(self.strengths) - set(STRENGTHS))
        if unknown:
            raise ValueError(f"expected auto, all, none or effects among {', '.join(EFFECT_NAMES)}, got {unknown}")
        if any(not 0 <= value <= 1 for value in self.strengths.values()):
            raise ValueError(f"expected strengths in [0,1], got {dict(self.strengths)}")


@dataclass(frozen=True)
class Planned:
    """One effect of a plan: `seconds` is the CPU time of its own work over the whole clip, as estimated, were it on."""

    name: str
    on: bool
    reason: str
    seconds: float
    evidence: Mapping[str, float]
    quality: int


@dataclass(frozen=True)
class Plan:
    """Effects in the order of their application, and what the clip costs without any."""

    effects: tuple[Planned, ...]
    base_seconds: float
    frames: int
    strengths: Mapping[str, float] = field(default_factory=dict)

    def on(self, name: str) -> bool:
        """Whether an effect is applied."""
        return self[name].on

    def __getitem__(self, name: str) -> Planned:
        return next(effect for effect in self.effects if effect.name == name)

    @property
    def seconds(self) -> float:
        """CPU-seconds of the whole clip, as estimated."""
        return self.base_seconds + sum(effect.seconds for effect in self.effects if effect.on)

    @property
    def samples(self) -> int:
        """Pictures that make one frame."""
        sampled = [self[name].quality for name in ("motion_blur", "depth_of_field") if self.on(name)]
        return max(sampled, default=1)

    def strength(self, name: str) -> float:
        """The knob of an effect."""
        return self.strengths.get(name, STRENGTHS[name])


def plan_effects(scene: Scene, puppets: Sequence[Puppet], shot: Shot, request: Request | None = None) -> Plan:
    """Look at scene, avatars (each with its motion) and camera, and decide.

    Args:
        scene: In our world.
        puppets: Avatars with their motions, placed.
        shot: The camera over time.
        request: What the user asks for; `auto` by default.

    Returns:
        Every effect with its state, its reason and its estimate.
    """
    request = request or Request()
    content = Content(scene, tuple(puppets), shot)
    planned = tuple(_planned(effect, content, request) for effect in EFFECTS)
    base = base_seconds(content, request.rates, joint=planned[EFFECT_NAMES.index("occlusion")].on)
    plan = Plan(planned, base, content.frames, request.strengths)
    return _with_shared_work(plan, content, request.rates)


def _planned(effect: Effect, content: Content, request: Request) -> Planned:
    if request.effects == "none":
        # Not even judged: what is off costs nothing.
        return Planned(effect.name, False, "no effects were asked for", 0.0, {}, 1)
    if not effect.possible(content):
        verdict = (
            effect.judge(content) if request.effects == "auto" else Verdict(False, "there is nothing to apply it to")
        )
        return Planned(effect.name, False, verdict.reason, 0.0, verdict.evidence, 1)
    named = request.effects not in ("auto", "all")
    if named and effect.name not in request.effects:
        return Planned(effect.name, False, "it was not asked for", 0.0, {}, 1)
    verdict = effect.judge(content)
    on = verdict.called_for or request.effects != "auto"
    reason = verdict.reason if verdict.called_for or not on else f"asked for, though {verdict.reason}"
    seconds = effect.seconds(content, verdict, request.rates)
    return Planned(effect.name, on, reason, seconds, verdict.evidence, verdict.quality)


def base_seconds(content: Content, rates: Rates, joint: bool = False) -> float:
    """CPU-seconds without effects: posing and drawing the avatars, drawing the scene, storing pictures.

    Args:
        content: The clip.
        rates: Of this machine.
        joint: Avatars and scene are drawn together, which is the work of an effect.
    """
    each = mapping(content, rates) + posing(content, rates) + content.pixels * rates.write
    each += 0.0 if joint else over_seconds(content, rates)
    views = 1 if content.shot.still else 0 if joint else content.frames
    drawn = rates.raster(content.scene_load) if len(content.scene) else 0.0
    return content.frames * each + views * drawn


def over_seconds(content: Content, rates: Rates) -> float:
    """CPU-seconds of drawing the avatars over a picture that is there."""
    window = content.avatar_window
    area = 0.0 if window is None else float(window[2] * window[3])
    return rates.raster(content.avatar_load._replace(pixels=area)) + content.pixels * rates.paste


def _with_shared_work(plan: Plan, content: Content, rates: Rates) -> Plan:
    """Estimates of blur and focus with what the other effects make of each of their samples.

    Samples of blur and focus are the same samples. Avatars are posed three times an exposure at most, light and shadow
    are those of its middle; but every place of the lens has a view of its own.
    """
    effects = {effect.name: effect for effect in plan.effects}
    names = [name for name in ("motion_blur", "depth_of_field") if plan.on(name)]
    if not names:
        return plan
    most = max(names, key=lambda name: effects[name].quality)
    more = plan.samples - 1
    each = joint_seconds(content, rates) if plan.on("occlusion") else over_seconds(content, rates)
    once = 0.0
    if plan.on("motion_blur"):
        each += min(KNOTS - 1, more) * posing(content, rates) / max(1, more)
    if not content.shot.still:
        each += 0.0 if plan.on("occlusion") else rates.raster(content.scene_load)
    elif plan.on("depth_of_field"):
        once = more * rates.raster(content.scene_load)
        each += redraw_seconds(content, rates) if plan.on("contact_shadow") else 0.0
    total = effects[most].seconds + content.frames * more * each + once
    for name in names:
        effects[name] = replace(effects[name], seconds=total if name == most else 0.0)
    return replace(plan, effects=tuple(effects.values()))
