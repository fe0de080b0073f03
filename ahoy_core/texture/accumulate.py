"""All frames into one observed atlas: a first pass asks what most frames show, a second one writes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import torch

from ahoy_core.body.model import BodyModel
from ahoy_core.texture.atlas import AtlasAccumulator, ObservedAtlas
from ahoy_core.texture.consensus import LEAST_VOTES, Consensus, Votes
from ahoy_core.texture.exposure import Exposure
from ahoy_core.texture.inputs import TextureConfig
from ahoy_core.texture.rays import Caster, FloatArray, IntArray, to_camera
from ahoy_core.texture.surface import REFERENCE_HEIGHT, SeenFrame, Surface, height_in_pixels, trust
from ahoy_core.texture.texels import TexelMap

Progress = Callable[[int, int], None]
# Bodies posed in one call: enough to fill torch's vector units, few enough that vertices of long videos are never
# held together.
POSED_TOGETHER = 16
# Frames that vote on a texel's colour, spread over the video: bounds the cost and the memory of the first pass.
VOTING_FRAMES = 16


class SecondOpinion(Protocol):
    """Somebody else's word on the surface (`ahoy_core.texture.dense`)."""

    def registered(
        self, number: int, caster: Caster, K: FloatArray, image: IntArray, visible: IntArray
    ) -> tuple[IntArray, IntArray]:
        """A frame's picture [H,W,3] and mask [H,W], moved to where the fitted body has them."""
        ...

    def checked(self, number: int, seen: SeenFrame) -> SeenFrame:
        """The frame without trust where another surface is seen than the fitted body's."""
        ...


@dataclass(frozen=True)
class Log:
    """By frame number: texels written, the shift found (x, y in pixels), the mean gain where exposure was changed."""

    written: dict[int, int] = field(default_factory=dict)
    shifts: dict[int, tuple[float, float]] = field(default_factory=dict)
    gains: dict[int, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Look:
    """One frame about to be read.

    Its number, how it is seen (None: its body is not finite), its picture [H,W,3] uint8 at the atlas's exposure, its
    mask [H,W] uint8, and what was changed for that.
    """

    number: int
    seen: SeenFrame | None
    image: IntArray
    visible: IntArray
    shift: tuple[float, float] = (0.0, 0.0)
    exposure: Exposure | None = None


@dataclass(frozen=True)
class Clip:
    """Frames [T,H,W,3] uint8, visible masks [T,H,W] uint8, the arrays of body.npz, the body and the knobs.

    `second` is somebody else's word on which surface a pixel shows.
    """

    frames: IntArray
    visible: IntArray
    fit: Mapping[str, np.ndarray]
    body: BodyModel
    surface: Surface
    config: TextureConfig
    second: SecondOpinion | None = None


def accumulate(
    clip: Clip, texels: TexelMap, points: FloatArray, chosen: list[int], progress: Progress | None = None
) -> tuple[ObservedAtlas, Log]:
    """The observed atlas of the chosen frames, and what happened on the way.

    Args:
        clip: the video and its fit.
        texels: the atlas's N texels.
        points: [N,3] where they are on the canonical body, metres.
        chosen: frame numbers, in the order of writing.
        progress: called with frames done and frames in all, of both passes.
    """
    config, voters = clip.config, _voters(chosen, clip.config)
    total, done = len(voters) + len(chosen), 0
    consensus = None
    if voters:
        votes, atlas = Votes(len(texels.face), len(voters)), _atlas(clip, texels, None)
        gains = []
        for view in _looks(clip, atlas, voters):
            if view.seen is not None:
                gains.append(np.ones(3) if view.exposure is None else view.exposure.gain)
                texel, rgb, _, _ = atlas.read(view.image, view.visible, view.seen)
                votes.add(texel, rgb)
                atlas.add(view.number, view.image, view.visible, view.seen)
            done = _report(progress, done, total)
        # 0 levels: everything is written, and the consensus only ranks it.
        consensus = votes.consensus(points, config.outlier_levels or 255.0)
        if gains:
            # So far everything has the first frame's exposure; the clip's is that of its middle one.
            consensus = consensus.scaled(1 / np.median(gains, axis=0))
    atlas, log = _atlas(clip, texels, consensus), Log()
    weights, fit = clip.body.lbs_weights.cpu().numpy(), clip.fit
    for view in _looks(clip, atlas, chosen):
        t = view.number
        log.shifts[t], log.written[t] = view.shift, 0
        if view.exposure is not None:
            log.gains[t] = float(view.exposure.gain.mean())
        if view.seen is not None:
            confidence = fit["frame_confidence"][t] * (weights @ fit["joint_confidence"][t])
            floor = config.min_joint_confidence * float(fit["frame_confidence"][t])
            log.written[t] = atlas.add(t, view.image, view.visible, view.seen, confidence, floor)
        done = _report(progress, done, total)
    return atlas.result(), log


def _voters(chosen: list[int], config: TextureConfig) -> list[int]:
    if (config.outlier_levels == 0 and config.rule != "median") or len(chosen) < LEAST_VOTES:
        return []
    rows = np.unique(np.linspace(0, len(chosen) - 1, min(VOTING_FRAMES, len(chosen))).round().astype(int))
    return [chosen[row] for row in rows]


def _atlas(clip: Clip, texels: TexelMap, consensus: Consensus | None) -> AtlasAccumulator:
    return AtlasAccumulator(clip.surface, texels, clip.config.rule, clip.config.grazing_cos, consensus)


def _report(progress: Progress | None, done: int, total: int) -> int:
    if progress is not None:
        progress(done + 1, total)
    return done + 1


def _looks(clip: Clip, atlas: AtlasAccumulator, numbers: list[int]) -> Iterator[Look]:
    """Frames looked at, moved and lit as they agree best with the atlas."""
    config, K = clip.config, clip.fit["K"]
    for t, vertices in _posed(clip, numbers):
        image, visible = clip.frames[t], clip.visible[t]
        if not np.isfinite(vertices).all():
            yield Look(t, None, image, visible)
            continue
        caster = Caster(to_camera(vertices, clip.fit["viewmat"]), clip.surface.faces)
        if clip.second is not None:
            image, visible = clip.second.registered(t, caster, K, image, visible)
        seen = _trusted(clip, t, caster, K, visible)
        exposure = atlas.exposure(image, seen, config.exposure)
        image = image if exposure is None else exposure.apply(image)
        reach = config.align_px * height_in_pixels(seen.hits) / REFERENCE_HEIGHT
        shift = atlas.shift(image, seen, reach)
        if shift != (0.0, 0.0):
            seen = _trusted(clip, t, caster, _shifted(K, shift), visible)
        yield Look(t, seen, image, visible, shift, exposure)


def _trusted(clip: Clip, number: int, caster: Caster, K: FloatArray, visible: IntArray) -> SeenFrame:
    seen = trust(clip.surface, caster, K, visible, clip.config.grazing_cos, clip.config.boundary_px)
    return seen if clip.second is None else clip.second.checked(number, seen)


def _shifted(K: FloatArray, shift: tuple[float, float]) -> FloatArray:
    moved = np.array(K, dtype=np.float64)
    moved[:2, 2] += shift
    return moved


def _posed(clip: Clip, chosen: list[int]) -> Iterator[tuple[int, FloatArray]]:
    """Frame numbers and posed vertices [V,3], a few frames posed at a time."""
    body, fit = clip.body, clip.fit
    like = body.lbs_weights
    betas = torch.as_tensor(fit["betas"]).to(like)
    for start in range(0, len(chosen), POSED_TOGETHER):
        numbers = chosen[start : start + POSED_TOGETHER]
        pose, transl, expression = (
            torch.as_tensor(fit[name][numbers]).to(like) for name in ("pose", "transl", "expression")
        )
        with torch.no_grad():
            output = body(pose, betas.expand(len(numbers), -1), transl, expression)
        yield from zip(numbers, output.vertices.cpu().numpy(), strict=True)
