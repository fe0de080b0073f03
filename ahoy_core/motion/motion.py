"""A motion: poses of the body in use over time, at a fixed rate."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ahoy_core.body.rotations import axis_angle_to_matrix, matrix_to_axis_angle


@dataclass(frozen=True)
class Motion:
    """A motion of T frames.

    Attributes:
        name: What it shows.
        pose: [T,J,3] axis-angle, radians, joint 0 in the world.
        transl: [T,3] metres, world.
        fps: Frames per second.
        expression: [T,E] of the body in use, or None: neutral throughout.
        notes: What was repaired, left out or assumed when it was read, one sentence each.
    """

    name: str
    pose: Tensor
    transl: Tensor
    fps: float
    expression: Tensor | None = None
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        count = len(self.pose)
        if self.pose.ndim != 3 or self.pose.shape[2] != 3 or tuple(self.transl.shape) != (count, 3):
            raise ValueError(
                f"expected pose [T,J,3] and transl [T,3], got {tuple(self.pose.shape)} and {tuple(self.transl.shape)}"
            )
        if self.expression is not None and (self.expression.ndim != 2 or len(self.expression) != count):
            raise ValueError(f"expected expression [{count},E], got {tuple(self.expression.shape)}")

    def __len__(self) -> int:
        return len(self.pose)

    @property
    def seconds(self) -> float:
        """Time from the first frame to the end of the last."""
        return len(self) / self.fps

    def rotations(self) -> Tensor:
        """[T,J,3,3] parent-relative rotations."""
        return axis_angle_to_matrix(self.pose)


def placed(motion: Motion, at: Tensor, heading: float, root_rest: Tensor) -> Motion:
    """The motion carried to another place: turned about the vertical through its start, which comes to `at`.

    Args:
        motion: T frames.
        at: [3] metres, world: where the root's starting point goes in x and y; z is added to the heights.
        heading: Radians to the left (counter-clockwise from above).
        root_rest: [3] the root joint at rest, about which the root's rotation turns the body.
    """
    turn = axis_angle_to_matrix(motion.pose.new_tensor([0.0, 0.0, heading]))
    root = motion.transl + root_rest
    flat = root.new_tensor([1.0, 1.0, 0.0])
    moved = (root - root[0] * flat) @ turn.T + at.to(root)
    pose = motion.pose.clone()
    pose[:, 0] = matrix_to_axis_angle(turn @ axis_angle_to_matrix(motion.pose[:, 0]))
    return replace(motion, pose=pose, transl=moved - root_rest)


def joined(first: Tensor, omega: Tensor, joint: int) -> Tensor:
    """Poses [T,J,3] with one joint turned further by omega [T,3], in the axes of rest space."""
    turned = axis_angle_to_matrix(omega) @ axis_angle_to_matrix(first[:, joint])
    return torch.cat([first[:, :joint], matrix_to_axis_angle(turned)[:, None], first[:, joint + 1 :]], 1)
