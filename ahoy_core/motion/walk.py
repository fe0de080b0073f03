"""Everyday motions from formulas: standing, walking and sitting down, with feet that stay where they are put.

Legs are solved from where the ankles are (`legs`), so a standing foot does not slide by construction.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ahoy_core.body.canonical import canonical_pose, canonical_transl
from ahoy_core.body.convert import body_skeleton
from ahoy_core.body.lbs import global_rotations
from ahoy_core.body.model import BodyModel
from ahoy_core.body.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from ahoy_core.motion.legs import SIDES, joints_of, legs_of, reach_ankles
from ahoy_core.motion.motion import Motion, joined
from ahoy_core.motion.procedural import frame_times, joint_named, smooth

STEP_RATE = 1.8
"""Steps a second of the walk."""
STEP_LENGTH = 0.36
"""Of a step, as a share of the leg's length: 0.3 m for an average adult, an unhurried walk."""
SEAT_HEIGHT = 0.45
"""Metres: of a chair, above the ground."""
# Radians from the canonical pose: the arms hang at the sides.
_ARM_DOWN = math.radians(32)
_ARM_SWING = math.radians(18)
_ELBOW = math.radians(12)
# Share of the leg's length: how far the pelvis sinks so that a step is within reach, and how high a foot is lifted.
_SINK, _LIFT, _BOB = 0.035, 0.11, 0.012
# Share of a step's time during which both feet are on the ground.
_DOUBLE = 0.2
_TOE_PITCH = math.radians(28)


def standing_pose(body: BodyModel) -> Tensor:
    """The canonical pose [J,3] with the arms hanging."""
    pose = canonical_pose(body).float()[None]
    for side in SIDES:
        sign = 1.0 if side == "left" else -1.0
        pose = joined(pose, torch.tensor([[0.0, sign * _ARM_DOWN, 0.0]]), joint_named(body, "upper_arm", side))
    return pose[0]


def walk(body: BodyModel, frames: int, fps: float, betas: Tensor | None = None) -> Motion:
    """A walk straight ahead (-y) on level ground, soles on z = 0 when the foot is down.

    Args:
        body: The body model.
        frames: T.
        fps: Frames per second.
        betas: [S] whose legs walk; the average adult's by default.

    Raises:
        ValueError: If frames or fps is not positive.
    """
    frame_times(frames, fps)
    base, start, rest = _start(body, betas)
    ankles = joints_of(body, axis_angle_to_matrix(base[None]), rest, start[None])[0]
    leg_length = float(ankles[legs_of(body)["left"].hip, 2] - ankles[legs_of(body)["left"].ankle, 2])
    step = STEP_LENGTH * leg_length
    phase = torch.arange(frames, dtype=torch.float32) / fps * STEP_RATE
    progress = phase * step
    pose = base.expand(frames, -1, -1)
    swing = torch.cos(math.pi * phase)
    for side in SIDES:
        sign = -1.0 if side == "left" else 1.0
        omega = torch.stack([sign * _ARM_SWING * swing, torch.zeros(frames), torch.zeros(frames)], 1)
        pose = joined(pose, omega, joint_named(body, "upper_arm", side))
        bend = torch.tensor([[-_ELBOW, 0.0, 0.0]]).expand(frames, 3)
        pose = joined(pose, bend, joint_named(body, "forearm", side))
    bob = _BOB * leg_length * torch.cos(2 * math.pi * phase)
    rise = torch.stack([torch.zeros(frames), -progress, bob - _SINK * leg_length], 1)
    targets: dict[str, Tensor] = {}
    for number, foot in enumerate(SIDES):
        leg = legs_of(body)[foot]
        ahead, lift, pitch = _foot(phase + number)
        # Feet land a little closer together than they stand in the canonical pose.
        place = ankles[leg.ankle] * torch.tensor([0.6, 1.0, 1.0])
        targets[foot] = place + torch.stack(
            [torch.zeros(frames), -step * (ahead - number), _LIFT * leg_length * lift], 1
        )
        omega = torch.stack([_TOE_PITCH * pitch, torch.zeros(frames), torch.zeros(frames)], 1)
        pose = joined(pose, omega, leg.ankle)
    pose = reach_ankles(body, pose, start + rise, rest, targets)
    return Motion("walk", pose, start + rise, fps)


def _foot(phase: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Of one foot, which steps once in two units of phase: place in steps, lift in [0,1], pitch in [-1,1]."""
    cycle = torch.floor(phase / 2)
    share = phase - 2 * cycle
    air = ((share - 1 - _DOUBLE / 2) / (1 - _DOUBLE)).clamp(0, 1)
    ahead = 2 * cycle + 0.5 + 2 * smooth(air)
    lift = torch.sin(math.pi * air) ** 2
    pitch = lift * torch.cos(math.pi * air)
    return ahead, lift, pitch


def sit(body: BodyModel, frames: int, fps: float, betas: Tensor | None = None, seat: float = SEAT_HEIGHT) -> Motion:
    """Sit down on a seat behind the person in the first two seconds, then stay seated; the feet stay where they are.

    Args:
        body: The body model.
        frames: T.
        fps: Frames per second.
        betas: [S] shape; the average adult's by default.
        seat: Height of the seat, metres; the pelvis comes to rest one thigh's thickness (8 cm) above it.

    Raises:
        ValueError: If frames or fps is not positive, or the seat is not between 0.1 m and the standing hip.
    """
    frame_times(frames, fps)
    base, start, rest = _start(body, betas)
    joints = joints_of(body, axis_angle_to_matrix(base[None]), rest, start[None])[0]
    legs = legs_of(body)
    hip = joints[legs["left"].hip]
    thigh = float((joints[legs["left"].knee] - hip).norm())
    if not 0.1 <= seat <= float(hip[2]) - 0.1:
        raise ValueError(f"expected a seat between 0.1 m and {float(hip[2]) - 0.1:.2f} m, got {seat}")
    down = smooth(torch.arange(frames, dtype=torch.float32) / fps / 2.0)
    drop = float(hip[2]) - (seat + 0.08)
    move = torch.stack([torch.zeros(frames), 0.92 * thigh * down, -drop * down], 1)
    lean = math.radians(28) * torch.sin(math.pi * down) + math.radians(4) * down
    pose = joined(base.expand(frames, -1, -1), torch.stack([lean, torch.zeros(frames), torch.zeros(frames)], 1), 0)
    # The root leans about itself, so the hips move: the root is set from where they should be.
    turn = axis_angle_to_matrix(torch.stack([lean, torch.zeros(frames), torch.zeros(frames)], 1))
    offset = hip - joints[0]
    transl = start + move + offset - (turn @ offset)
    for side in SIDES:
        reach = torch.stack([-math.radians(22) * down, torch.zeros(frames), torch.zeros(frames)], 1)
        pose = joined(pose, reach, joint_named(body, "upper_arm", side))
        pose = joined(pose, 2.2 * reach, joint_named(body, "forearm", side))
    targets: dict[str, Tensor] = {side: joints[legs[side].ankle].expand(frames, 3) for side in SIDES}
    pose = reach_ankles(body, pose, transl, rest, targets)
    return Motion("sit", _flat_feet(body, pose, base), transl, fps)


def _flat_feet(body: BodyModel, pose: Tensor, base: Tensor) -> Tensor:
    """Poses whose feet are oriented in the world as in the standing pose: the lean of the root must not tip them."""
    level = global_rotations(axis_angle_to_matrix(base[None]), body.parents)
    world = global_rotations(axis_angle_to_matrix(pose), body.parents)
    pose = pose.clone()
    for side in SIDES:
        ankle = legs_of(body)[side].ankle
        local = world[:, body.parents[ankle]].transpose(1, 2) @ level[:, ankle]
        pose[:, ankle] = matrix_to_axis_angle(local)
    return pose


def _start(body: BodyModel, betas: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """Standing pose [J,3], the translation [3] that puts it on the ground, and rest joints [J,3]."""
    shape = body.default_betas if betas is None else betas
    rest = body_skeleton(body, shape).rest_joints.float()
    return standing_pose(body), canonical_transl(body, shape).float(), rest
