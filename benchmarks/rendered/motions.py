"""Motions written as joint angles over time: standing, stepping, reaching, waving, bending, squatting, turning."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation

from ahoy_core.body.packaged import PackagedBody

FloatArray = NDArray[np.float64]
Dofs = dict[str, FloatArray]
KINDS = ("stand", "step", "reach", "wave", "bend", "squat", "turn", "lunge", "raise")
X, Y, Z = np.eye(3)
# Degrees that everybody's joints wander by, and where they wander about.
IDLE: Mapping[str, tuple[float, float]] = {
    "arm_out": (11, 7), "arm_forward": (3, 12), "arm_twist": (0, 18), "elbow": (22, 16), "wrist": (0, 12),
    "curl": (25, 12),
    "hip_out": (2, 4), "hip_turn": (6, 6), "hip_flex": (2, 3), "knee": (4, 4),
}  # fmt: skip
MIDDLE: Mapping[str, tuple[float, float]] = {
    "bend": (4, 5), "twist": (0, 9), "lean": (0, 4), "head_yaw": (0, 20), "head_pitch": (3, 9), "head_roll": (0, 4),
    "pelvis_tilt": (0, 3), "pelvis_roll": (0, 2),
}  # fmt: skip


def sample_motion(rng: np.random.Generator, kind: str, frames: int, fps: float) -> Dofs:
    """Draw angles in degrees, [T] each: sides end in `_L` and `_R`, `yaw` turns the whole body."""
    time = np.arange(frames) / fps
    dofs = {name: _wander(rng, time, mean, spread) for name, (mean, spread) in MIDDLE.items()}
    for name, (mean, spread) in IDLE.items():
        for side in "LR":
            dofs[f"{name}_{side}"] = _wander(rng, time, mean, spread)
    facing = rng.normal(0, 28) + (180 if rng.random() < 0.06 else 0)
    dofs["yaw"] = facing + _wander(rng, time, 0, 8)
    side, other = rng.permutation(["L", "R"])
    pulse = _pulses(rng, time)
    if kind == "step":
        _step(rng, dofs, time)
    elif kind == "reach":
        dofs[f"arm_forward_{side}"] += pulse * rng.uniform(45, 95)
        dofs[f"elbow_{side}"] += pulse * rng.uniform(-15, 25)
        dofs["bend"] += pulse * rng.uniform(0, 30)
        if rng.random() < 0.5:
            dofs[f"arm_forward_{other}"] += pulse * rng.uniform(35, 85)
    elif kind == "wave":
        dofs[f"arm_out_{side}"] += pulse * rng.uniform(70, 140)
        dofs[f"elbow_{side}"] += pulse * (45 + 30 * np.sin(2 * np.pi * time * rng.uniform(1, 2)))
    elif kind == "bend":
        dofs["bend"] += pulse * rng.uniform(25, 65)
        for s in "LR":
            dofs[f"hip_flex_{s}"] += pulse * rng.uniform(5, 25)
            dofs[f"knee_{s}"] += pulse * rng.uniform(5, 30)
            dofs[f"arm_forward_{s}"] += pulse * rng.uniform(20, 70)
    elif kind == "squat":
        depth = pulse * rng.uniform(35, 95)
        for s in "LR":
            dofs[f"hip_flex_{s}"] += depth
            dofs[f"knee_{s}"] += 1.25 * depth
            dofs[f"arm_forward_{s}"] += pulse * rng.uniform(0, 80)
        dofs["bend"] += 0.25 * depth
    elif kind == "turn":
        dofs["yaw"] += (pulse - 0.5) * rng.uniform(60, 200) * rng.choice([-1, 1])
    elif kind == "lunge":
        depth = pulse * rng.uniform(25, 60)
        dofs[f"hip_flex_{side}"] += depth
        dofs[f"knee_{side}"] += depth
        dofs[f"hip_out_{side}"] += pulse * rng.uniform(0, 35)
        dofs[f"hip_flex_{other}"] -= 0.4 * depth
    elif kind == "raise":
        for s in "LR":
            dofs[f"arm_out_{s}"] += pulse * rng.uniform(60, 150)
    if rng.random() < 0.12:
        for s in "LR":
            dofs[f"arm_out_{s}"] += rng.uniform(15, 30)
            dofs[f"elbow_{s}"] += rng.uniform(55, 80)
            dofs[f"arm_twist_{s}"] -= rng.uniform(30, 60)
    return dofs


def carry(dofs: Dofs, rng: np.random.Generator) -> None:
    """Hold both hands in front of the belly, as round a box."""
    lift = rng.uniform(0, 15)
    for side in "LR":
        dofs[f"arm_out_{side}"] = 8 + 0.1 * dofs[f"arm_out_{side}"]
        dofs[f"arm_forward_{side}"] = 14 + lift + 0.1 * dofs[f"arm_forward_{side}"]
        dofs[f"elbow_{side}"] = 68 + 0.1 * dofs[f"elbow_{side}"]
        dofs[f"arm_twist_{side}"] = 0.1 * dofs[f"arm_twist_{side}"]


def pose_from_dofs(body: PackagedBody, rest_joints: FloatArray, dofs: Dofs) -> FloatArray:
    """Joint rotations [T,J,3], axis-angle of the packaged body; the root stays in place.

    Args:
        body: the packaged body.
        rest_joints: [J,3] of the shape: the arms' rest angles are read from it.
        dofs: see `sample_motion`.
    """
    index = {name: i for i, name in enumerate(body.joint_names)}
    pose = np.zeros((len(dofs["yaw"]), body.n_joints, 3))

    def put(joint: str, *turns: tuple[FloatArray, FloatArray | float]) -> None:
        total = Rotation.identity()
        for axis, degrees in turns:
            total = total * Rotation.from_rotvec(np.radians(np.broadcast_to(degrees, len(pose)))[:, None] * axis)
        pose[:, index[joint]] = total.as_rotvec()

    put("root", (Z, dofs["yaw"]), (X, dofs["pelvis_tilt"]), (Y, dofs["pelvis_roll"]))
    for joint, share in zip(
        ("spine05", "spine04", "spine03", "spine02", "spine01"), (0.1, 0.2, 0.3, 0.25, 0.15), strict=True
    ):
        put(joint, (Z, share * dofs["twist"]), (X, share * dofs["bend"]), (Y, share * dofs["lean"]))
    for joint, share in zip(("neck01", "neck02", "head"), (0.3, 0.3, 0.4), strict=True):
        put(joint, (Z, share * dofs["head_yaw"]), (X, share * dofs["head_pitch"]), (Y, share * dofs["head_roll"]))
    for side, sign in (("L", 1.0), ("R", -1.0)):
        upper, elbow, wrist = (rest_joints[index[f"{name}.{side}"]] for name in ("upperarm01", "lowerarm01", "wrist"))
        arm, forearm = (v / np.linalg.norm(v) for v in (elbow - upper, wrist - elbow))
        rest_out = np.degrees(np.arctan2(abs(arm[0]), -arm[2]))
        out = dofs[f"arm_out_{side}"]
        shrug = 0.35 * np.clip(out - 60, 0, None)
        put(f"clavicle.{side}", (Y, -sign * shrug))
        put(
            f"upperarm01.{side}", (X, -dofs[f"arm_forward_{side}"]), (Y, sign * (rest_out - out + shrug)),
            (arm, sign * dofs[f"arm_twist_{side}"]),
        )  # fmt: skip
        hinge = np.cross(arm, forearm)
        rest_bend = np.degrees(np.arcsin(min(1.0, float(np.linalg.norm(hinge)))))
        put(f"lowerarm01.{side}", (hinge / np.linalg.norm(hinge), np.clip(dofs[f"elbow_{side}"], 2, 145) - rest_bend))
        put(f"wrist.{side}", (X, dofs[f"wrist_{side}"]))
        knuckles = rest_joints[index[f"finger2-1.{side}"]] - rest_joints[index[f"finger5-1.{side}"]]
        knuckles /= np.linalg.norm(knuckles)
        for finger in range(2, 6):
            for joint in (1, 2, 3):
                put(f"finger{finger}-{joint}.{side}", (knuckles, sign * np.clip(dofs[f"curl_{side}"], 0, 70)))
        put(
            f"upperleg01.{side}", (Z, sign * dofs[f"hip_turn_{side}"]), (X, -dofs[f"hip_flex_{side}"]),
            (Y, -sign * dofs[f"hip_out_{side}"]),
        )  # fmt: skip
        knee = np.clip(dofs[f"knee_{side}"], 0, 140)
        put(f"lowerleg01.{side}", (X, knee))
        put(f"foot.{side}", (X, dofs[f"hip_flex_{side}"] - knee))
    return pose


def _wander(rng: np.random.Generator, time: FloatArray, mean: float, spread: float) -> FloatArray:
    """A smooth curve through random values about a second apart."""
    return _curve(rng, time, lambda n: mean + spread * rng.normal(size=n), (0.7, 1.6))


def _pulses(rng: np.random.Generator, time: FloatArray) -> FloatArray:
    """A smooth curve in [0,1] that comes and goes."""
    return _curve(
        rng, time, lambda n: np.clip((np.arange(n) + rng.integers(2)) % 2 + rng.normal(0, 0.15, n), 0, 1), (0.5, 1.1)
    )


def _curve(rng: np.random.Generator, time: FloatArray, draw, gap: tuple[float, float]) -> FloatArray:  # type: ignore[no-untyped-def]
    knots = np.cumsum(np.concatenate([[-1.0], rng.uniform(*gap, size=int((time[-1] + 4) / gap[0]))]))
    return np.asarray(PchipInterpolator(knots, draw(len(knots)))(time))


def _step(rng: np.random.Generator, dofs: Dofs, time: FloatArray) -> None:
    phase = 2 * np.pi * (time * rng.uniform(0.6, 1.2) + rng.random())
    high = rng.uniform(15, 55)
    for side, shift in (("L", 0.0), ("R", np.pi)):
        swing = np.clip(np.sin(phase + shift), 0, None)
        dofs[f"hip_flex_{side}"] += high * swing
        dofs[f"knee_{side}"] += 1.3 * high * swing
        dofs[f"arm_forward_{side}"] -= 0.5 * high * np.sin(phase + shift)
