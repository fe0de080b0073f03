"""Stage `animate`: the avatar -> turntable, a motion that the video does not show, and the standard splat file."""

from __future__ import annotations

import json
from collections.abc import Mapping

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from ahoy_core.animate import evenly_chosen, motion_frames, turntable
from ahoy_core.avatar.files import load_avatar
from ahoy_core.body.load import load_body
from ahoy_core.formats.images import contact_sheet, write_png
from ahoy_core.formats.ply import write_ply
from ahoy_core.formats.video import write_mp4
from ahoy_core.motion import wave
from tasks.roles import ours, packaged_body
from tasks.stage import Role, Stage, StageContext, StageOutput


class AnimateConfig(BaseModel):
    """Size and length of the two videos.

    Attributes:
        height, width: pixels.
        turntable_frames: frames of one full turn.
        motion_frames: frames of the motion.
        fps: frames a second of both.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    height: int = Field(default=512, ge=16, le=4096)
    width: int = Field(default=384, ge=16, le=4096)
    turntable_frames: int = Field(default=72, ge=8)
    motion_frames: int = Field(default=72, ge=1)
    fps: float = Field(default=24.0, gt=0, le=240)


def run_animate(config: AnimateConfig, ctx: StageContext) -> StageOutput:
    """Render both videos and export the canonical avatar."""
    avatar, body = load_avatar(ctx.inputs["avatar"]), load_body(ctx.body)
    label = {"comment": avatar.info.synthetic_media, "title": "Ahoy avatar"}
    total = config.turntable_frames + config.motion_frames
    ctx.progress(0, total, "turntable")
    turning = turntable(avatar, body, config.turntable_frames, config.height, config.width)
    write_mp4(ctx.out / "turntable.mp4", turning, config.fps, metadata=label)
    write_png(ctx.out / "turntable.png", contact_sheet(evenly_chosen(turning), columns=4))
    motion = wave(body, config.motion_frames, config.fps, turning=2 * np.pi)
    moving = motion_frames(
        avatar,
        body,
        motion,
        config.height,
        config.width,
        lambda done, _: ctx.progress(config.turntable_frames + done, total, "motion"),
    )
    write_mp4(ctx.out / "motion.mp4", moving, config.fps, metadata=label)
    observed = {"observed": avatar.observed.numpy()}
    comments = [avatar.info.synthetic_media, f"observed share of the surface: {avatar.observed_share:.3f}"]
    write_ply(ctx.out / "avatar.ply", avatar.to_gaussians(), observed, comments)
    facts = {"gaussians": len(avatar), "turntable": f"{config.turntable_frames} frames", "motion": "wave while turning"}
    (ctx.out / "animate.json").write_text(json.dumps(facts, indent=1), encoding="utf-8")
    return StageOutput(summary={"facts": facts}, pictures=("turntable.png",))


def _roles(config: AnimateConfig) -> Mapping[str, Role]:
    return {"body": packaged_body(), "rasterizer": ours("ahoy_core.splat on the CPU")}


ANIMATE = Stage("animate", 3, AnimateConfig, ("avatar",), run_animate, _roles)
