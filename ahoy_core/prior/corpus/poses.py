"""Poses and motions of the corpus, written in joint angles that a reader can picture."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ahoy_core.body.canonical import canonical_pose
from ahoy_core.body.packaged import PackagedBody
from ahoy_core.body.rotations import axis_angle_to_matrix

Array = NDArray[Any]
Angles = Mapping[str, float]
Action = Literal["canonical", "stand", "arms up", "one arm up", "free", "step", "sit", "squat", "lunge", "reach"]

ACTIONS: Final[dict[Action, float]] = {
    "canonical": 0.15,
    "stand": 0.27,
    "arms up": 0.12,
    "one arm up": 0.08,
    "free": 0.2,
    "step": 0.1,
    "sit": 0.08,
}
"""Share of each action in training."""
HELD_OUT_ACTIONS: Final[tuple[Action, ...]] = ("squat", "lunge", "reach")

_SPINE = {"spine05": 0.1, "spine04": 0.2, "spine03": 0.3, "spine02": 0.25, "spine01": 0.15}
_NECK = {"neck01": 0.3, "neck02": 0.3, "head": 0.4}


def random_angles(rng: np.random.Generator, action: Action) -> dict[str, float]:
    """Joint angles in degrees for an action; sides end in `.L` and `.R`. Unused for "canonical"."""

    def uniform(low: float, high: float) -> float:
        return float(rng.uniform(low, high))

    sides = ("L", "R")
    angles = {"bend": uniform(-3, 8), "twist": uniform(-8, 8), "lean": uniform(-4, 4)}
    angles |= {"head yaw": uniform(-25, 25), "head pitch": uniform(-8, 10)}
    for s in sides:
        angles |= {f"abduct.{s}": uniform(5, 30), f"raise.{s}": uniform(-12, 20), f"elbow.{s}": uniform(5, 40)}
        angles |= {f"hip.{s}": uniform(-4, 6), f"spread.{s}": uniform(0, 7), f"knee.{s}": uniform(0, 10)}
        angles |= {f"curl.{s}": uniform(5, 45), f"roll.{s}": uniform(-20, 20)}
    side, other = ("L", "R") if rng.random() < 0.5 else ("R", "L")
    if action == "arms up":
        angles |= {f"abduct.{s}": uniform(70, 165) for s in sides}
    elif action == "one arm up":
        angles |= {f"abduct.{side}": uniform(80, 165), f"elbow.{side}": uniform(5, 100)}
    elif action == "free":
        for s in sides:
            angles |= {f"raise.{s}": uniform(-25, 95), f"elbow.{s}": uniform(5, 120), f"roll.{s}": uniform(-45, 45)}
            angles |= {f"hip.{s}": uniform(-8, 25), f"knee.{s}": uniform(2, 35), f"abduct.{s}": uniform(5, 60)}
        angles |= {"bend": uniform(-6, 25), "twist": uniform(-25, 25), "head yaw": uniform(-45, 45)}
    elif action == "step":
        swing = uniform(12, 35)
        angles |= {f"hip.{side}": swing, f"knee.{side}": uniform(5, 45), f"hip.{other}": -0.6 * swing}
        angles |= {f"raise.{side}": -swing, f"raise.{other}": swing, f"knee.{other}": uniform(2, 20)}
    elif action in ("sit", "squat"):
        depth = uniform(75, 95) if action == "sit" else uniform(60, 110)
        for s in sides:
            angles |= {f"hip.{s}": depth, f"knee.{s}": depth + uniform(-10, 15), f"spread.{s}": uniform(3, 15)}
            angles |= {f"raise.{s}": uniform(5, 50), f"elbow.{s}": uniform(10, 90)}
        angles["bend"] = uniform(0, 15) if action == "sit" else uniform(10, 35)
    elif action == "lunge":
        angles |= {f"hip.{side}": uniform(45, 75), f"knee.{side}": uniform(60, 90), f"hip.{other}": uniform(-25, -10)}
        angles |= {f"knee.{other}": uniform(20, 60)}
    elif action == "reach":
        angles |= {f"raise.{side}": uniform(100, 170), f"elbow.{side}": uniform(0, 25), "lean": uniform(-15, 15)}
    return angles


def pose_rotations(body: PackagedBody, angles: Angles) -> Tensor:
    """Parent-relative rotations [J,3,3] in rest axes for joint angles in degrees.

    "raise" and "hip" swing a limb forwards, "abduct" and "spread" away from the body (abduct 0: the arm hangs).
    """
    names = list(body.joint_names)
    rest: NDArray[Any] = body.shape(body.default_betas[None])[1][0].double().numpy()
    turns = np.tile(np.eye(3), (body.n_joints, 1, 1))

    def angle(name: str, default: float = 0.0) -> float:
        return math.radians(angles.get(name, default))

    x, y, z = np.eye(3)
    for joint, share in _SPINE.items():
        turns[names.index(joint)] = _turn(z, share * angle("twist")) @ _turn(x, share * angle("bend"))
        turns[names.index(joint)] @= _turn(y, share * angle("lean"))
    for joint, share in _NECK.items():
        turns[names.index(joint)] = _turn(z, share * angle("head yaw")) @ _turn(x, share * angle("head pitch"))
    for side, sign in (("L", 1.0), ("R", -1.0)):

        def at(name: str, side: str = side) -> int:
            return names.index(f"{name}.{side}")

        upper = _unit(rest[at("lowerarm01")] - rest[at("upperarm01")])
        fore = _unit(rest[at("wrist")] - rest[at("lowerarm01")])
        hanging = math.atan2(abs(float(upper[0])), -float(upper[2]))
        lift = angle(f"abduct.{side}", 8)
        shrug = 0.35 * max(0.0, lift - math.radians(60))
        turns[at("clavicle")] = _turn(y, -sign * shrug)
        turns[at("upperarm01")] = (
            _turn(x, -angle(f"raise.{side}"))
            @ _turn(y, sign * (hanging - lift + shrug))
            @ _turn(upper, sign * angle(f"roll.{side}"))
        )
        hinge = np.cross(upper, fore)
        bent = math.asin(min(1.0, float(np.linalg.norm(hinge))))
        turns[at("lowerarm01")] = _turn(hinge, angle(f"elbow.{side}", 15) - bent)
        knuckles = rest[at("finger2-1")] - rest[at("finger5-1")]
        for finger in range(2, 6):
            for phalanx in (1, 2, 3):
                turns[at(f"finger{finger}-{phalanx}")] = _turn(knuckles, sign * angle(f"curl.{side}", 22))
        turns[at("upperleg01")] = _turn(x, -angle(f"hip.{side}")) @ _turn(y, -sign * angle(f"spread.{side}"))
        turns[at("lowerleg01")] = _turn(x, angle(f"knee.{side}"))
    return torch.from_numpy(turns).float()


def action_rotations(body: PackagedBody, rng: np.random.Generator, action: Action, frames: int) -> Tensor:
    """A pose [1,J,3,3] held, or with `frames` > 1 a smooth motion [frames,J,3,3] from standing into the action."""
    if action == "canonical":
        return axis_angle_to_matrix(canonical_pose(body))[None].expand(frames, -1, -1, -1)
    end = random_angles(rng, action)
    if frames == 1:
        return pose_rotations(body, end)[None]
    start = random_angles(rng, "stand")
    shares = 0.5 - 0.5 * np.cos(np.linspace(0, math.pi * rng.uniform(0.6, 1.6), frames))
    steps = [{k: (1 - u) * start.get(k, 0.0) + u * end.get(k, 0.0) for k in start | end} for u in shares]
    return torch.stack([pose_rotations(body, step) for step in steps])


def _unit(vector: Array) -> Array:
    return np.asarray(vector / np.linalg.norm(vector))


def _turn(axis: Array, radians: float) -> Array:
    """Rodrigues' formula in numpy: hundreds of these make one pose."""
    x, y, z = _unit(axis)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(radians) * K + (1 - math.cos(radians)) * (K @ K)
