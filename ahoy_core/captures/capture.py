"""One capture in the form that scoring takes, whatever its files look like."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from ahoy_core.body.convert import (
    Skeleton,
    SkeletonPose,
    body_skeleton,
    convert_pose,
    joint_map,
    skeleton_joints,
)
from ahoy_core.body.model import BodyModel
from ahoy_core.body.packaged import load_packaged_body
from ahoy_core.body.rotations import matrix_to_axis_angle
from ahoy_core.body.smpl_names import is_limb
from ahoy_core.conventions import Cameras

Moment = Literal["view", "pose", "input"]
"""What a true picture shows: a moment of the input, a pose that the input never shows, or the input itself."""

_SIDED = ("upperleg01", "lowerleg01", "foot", "upperarm01", "lowerarm01", "wrist")
ANCHORS = ("neck01", "head", *(f"{name}.{side}" for name in _SIDED for side in "LR"))
"""Joints of the packaged body that a driven body of another shape is laid onto: each limb's, trunk and head."""


@dataclass(frozen=True)
class View:
    """A true picture by name: `frame` counts the input's frames, or those of the unseen motion for "pose"."""

    moment: Moment
    camera: str
    frame: int


@dataclass(frozen=True)
class TruePicture:
    """A true picture of the person.

    Attributes:
        rgb: [3,H,W] sRGB in [0,1]; meaningless where alpha is 0.
        alpha: [H,W] of the person (for "input": of the visible part), [0,1].
        known: [H,W] bool; False where something stands in front of the person and the truth is not known.
    """

    rgb: Tensor
    alpha: Tensor
    known: Tensor


@dataclass(frozen=True)
class BodyTruth:
    """True body parameters of T frames, in the capture's world.

    Attributes:
        skeleton: that they belong to.
        pose: T poses of it.
        frames: number of each.
        betas: [S] true shape of the packaged body, None where the truth is of another body.
    """

    skeleton: Skeleton
    pose: SkeletonPose
    frames: tuple[int, ...]
    betas: Tensor | None = None

    def row(self, frame: int) -> int:
        """Which row is that of a frame.

        Raises:
            ValueError: there is none.
        """
        if frame not in self.frames:
            raise ValueError(f"expected true parameters of frame {frame}, got those of {list(self.frames)}; leave it")
        return self.frames.index(frame)

    def within(self, frames: Sequence[int]) -> BodyTruth:
        """The rows of some frames only."""
        rows = [row for row, frame in enumerate(self.frames) if frame in set(frames)]
        pose = SkeletonPose(self.pose.rotations[rows], self.pose.root[rows])
        return replace(self, pose=pose, frames=tuple(self.frames[row] for row in rows))


@dataclass(frozen=True)
class Capture:
    """A capture.

    Attributes:
        name: of it, unique in its data set.
        folder: where it lies.
        kind: name of its layout.
        video: the input as a video file, or None where `frames` makes it.
        frames: the input's pictures [H,W,3] uint8, in order, where there is no video file.
        fps: frames a second of the input.
        input_camera: name of the camera that made the input; its camera is None where it is not known.
        cameras: by name.
        views: true pictures there are.
        picture: loads one of them; a plain video has none, its own frames are the truth.
        bodies: true bodies, of "view" (all frames of the input that have one) and "pose".
        stands: the world is z up with the floor at z = 0, so that a method may be told where the camera stands.
        blur_faces: its licence asks that faces are blurred wherever pictures are shown.
        notes: what was left out or approximated, for the table.
    """

    name: str
    folder: Path
    kind: str
    views: tuple[View, ...]
    picture: Callable[[View], TruePicture]
    video: Path | None = None
    frames: Callable[[], Sequence[NDArray[np.uint8]]] | None = None
    fps: float = 15.0
    input_camera: str = ""
    cameras: Mapping[str, Cameras] = field(default_factory=dict)
    bodies: Mapping[str, BodyTruth] = field(default_factory=dict)
    stands: bool = False
    blur_faces: bool = False
    notes: tuple[str, ...] = ()

    def of(self, moment: Moment) -> tuple[View, ...]:
        """The views of one moment."""
        return tuple(view for view in self.views if view.moment == moment)


def drive(truth: BodyTruth, body: BodyModel, betas: Tensor) -> tuple[Tensor, Tensor]:
    """The true motion on a body of its own shape: world rotations carry over, and the joints stand where they did.

    Where the shape differs, not all joints can. The root alone would be a poor anchor (in the packaged body it lies at
    the back, so that a belly too large moves the legs forward by centimetres): the place is that of the least squared
    distance between its `ANCHORS` and the true ones. It depends on the truth and the shape, never on a picture.

    Args:
        truth: T true poses.
        body: to be driven.
        betas: [S] its shape.

    Returns:
        pose [T,J,3] axis-angle and transl [T,3] metres, in the capture's world.
    """
    target = body_skeleton(body, betas.float())
    moved = _converted(truth, target)
    packaged = load_packaged_body()
    names = joint_map(body.joint_names, packaged.joint_names) or {name: name for name in body.joint_names}
    pairs = [(mine, theirs) for mine, theirs in names.items() if theirs in ANCHORS]
    mine = skeleton_joints(target, moved)[:, [body.joint_names.index(name) for name, _ in pairs]]
    true = true_joints(truth)[:, [packaged.joint_names.index(name) for _, name in pairs]]
    transl = moved.root - target.rest_joints[0].to(moved.root) + (true.to(mine) - mine).mean(1)
    return matrix_to_axis_angle(moved.rotations).float(), transl.float()


def true_joints(truth: BodyTruth) -> Tensor:
    """Joints [T,J,3] of the packaged body in its true shape (the average where that is not known), metres, world."""
    skeleton = body_skeleton(load_packaged_body(), None if truth.betas is None else truth.betas.float())
    return skeleton_joints(skeleton, _converted(truth, skeleton)).float()


def _converted(truth: BodyTruth, target: Skeleton) -> SkeletonPose:
    joints = joint_map(target.joint_names, truth.skeleton.joint_names)
    return convert_pose(truth.skeleton, target, truth.pose, joints, is_limb)
