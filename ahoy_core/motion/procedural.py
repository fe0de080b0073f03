"""Motions from formulas: a turn and a wave; and the replay of a fitted video (paper section 3.2, "Structured Motion").

All start and end in the canonical pose and stay within the limits stated here, so that they are a fair first look at
any avatar.
"""

from __future__ import annotations

import math
from typing import Literal

import torch
from torch import Tensor

from ahoy_core.body.canonical import canonical_pose
from ahoy_core.body.model import BodyModel
from ahoy_core.motion.motion import Motion, joined

Side = Literal["left", "right"]

MAX_JOINT_SPEED = 8.0
"""Radians per second that no joint of a wave exceeds: that of a brisk human wave."""
# Radians: the canonical arms hang 45 degrees down; raised by this the upper arm is a little above the horizontal.
_RAISE = math.radians(50)
_BEND, _SWING = math.radians(75), math.radians(22)
_WAVES = 3
# Share of the clip that is spent on raising the arm, and again on lowering it.
_RAMP = 0.25
# Seconds: a shorter clip raises the arm less high, or it would have to be faster than the limit.
_FULL_RAISE = 1.5

_NAMES = {"upper_arm": ("upperarm01.{letter}", "{side}_shoulder"), "forearm": ("lowerarm01.{letter}", "{side}_elbow")}


def joint_named(body: BodyModel, part: str, side: Side) -> int:
    """Number of the joint "upper_arm" or "forearm" of a side, under whichever name the body has for it."""
    names = [pattern.format(side=side, letter=side[0].upper()) for pattern in _NAMES[part]]
    for name in names:
        if name in body.joint_names:
            return body.joint_names.index(name)
    raise ValueError(f"expected a joint named one of {names} in body {body.name!r}, got none; add its name to _NAMES")


def frame_times(frames: int, fps: float) -> Tensor:
    """Shares [T] in [0,1] of a clip that have passed at each frame; refuses an empty clip or rate."""
    if frames < 1 or not fps > 0:
        raise ValueError(f"expected at least one frame and a positive rate, got {frames} frames at {fps} per second")
    return torch.arange(frames, dtype=torch.float32) / max(1, frames - 1)


def turn(body: BodyModel, frames: int, fps: float, pose: Tensor | None = None) -> Motion:
    """One full turn on the spot, to the person's left, at constant speed.

    Args:
        body: The body model.
        frames: T; the last frame stands one step before the first, so that the clip loops.
        fps: Frames per second.
        pose: [J,3] held while turning; the canonical pose by default.

    Raises:
        ValueError: If frames or fps is not positive.
    """
    frame_times(frames, fps)
    held = canonical_pose(body) if pose is None else pose
    angles = 2 * math.pi * torch.arange(frames, dtype=torch.float32) / frames
    omega = torch.stack([torch.zeros(frames), torch.zeros(frames), angles], 1)
    return Motion("turn", joined(held.float().expand(frames, -1, -1), omega, 0), torch.zeros(frames, 3), fps)


def wave(body: BodyModel, frames: int, fps: float, side: Side = "right", turning: float = 0.0) -> Motion:
    """Raise an arm, wave, and lower it again, from and to the canonical pose.

    Args:
        body: The body model.
        frames: T.
        fps: Frames per second.
        side: Which arm.
        turning: Radians that the person turns to the left meanwhile; 2 pi shows all sides.

    Raises:
        ValueError: If frames or fps is not positive, or the body has no such arm.
    """
    t = frame_times(frames, fps)
    up = smooth(t / _RAMP) * smooth((1 - t) / _RAMP) * min(1.0, frames / fps / _FULL_RAISE)
    inside = ((t - _RAMP) / (1 - 2 * _RAMP)).clamp(0, 1)
    sway = torch.sin(2 * math.pi * _waves(frames, fps) * inside) * smooth(inside * 4) * smooth((1 - inside) * 4)
    sign = -1.0 if side == "left" else 1.0  # about y, from the hanging arm outwards and up
    pose = canonical_pose(body).float().expand(frames, -1, -1)
    axis = torch.tensor([0.0, sign, 0.0])
    pose = joined(pose, (_RAISE * up)[:, None] * axis, joint_named(body, "upper_arm", side))
    pose = joined(pose, (_BEND * up + _SWING * sway)[:, None] * axis, joint_named(body, "forearm", side))
    around = turning * smooth(t)
    pose = joined(pose, torch.stack([torch.zeros(frames), torch.zeros(frames), around], 1), 0)
    return Motion("wave and turn" if turning else "wave", pose, torch.zeros(frames, 3), fps)


def _waves(frames: int, fps: float) -> int:
    """Swings to and fro: three, fewer in a clip too short for the speed limit (half of it, as arm and root add up)."""
    seconds = frames / fps * (1 - 2 * _RAMP)
    return max(0, min(_WAVES, int(0.5 * MAX_JOINT_SPEED * seconds / (2 * math.pi * _SWING))))


def smooth(t: Tensor) -> Tensor:
    """0 before 0, 1 after 1, and a smooth step between (zero speed at both ends)."""
    t = t.clamp(0, 1)
    return t * t * (3 - 2 * t)


def replay(pose: Tensor, transl: Tensor, fps: float, used: Tensor | None = None) -> Motion:
    """The fitted motion of a video, without the frames in which nobody was fitted.

    Args:
        pose: [T,J,3] axis-angle, radians.
        transl: [T,3] metres, world.
        fps: Frames per second.
        used: [T] bool; all by default.

    Raises:
        ValueError: If no frame is left or a used pose is not finite.
    """
    keep = torch.ones(len(pose), dtype=torch.bool) if used is None else used
    if not bool(keep.any()) or not bool(torch.isfinite(pose[keep]).all() & torch.isfinite(transl[keep]).all()):
        raise ValueError(f"expected finite poses in at least one used frame, got {int(keep.sum())} used; check the fit")
    return Motion("replay", pose[keep].float(), transl[keep].float(), fps)
