"""From joint rotations to skinning transforms relative to the canonical pose, without posing a mesh."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ahoy_core.body.lbs import forward_kinematics
from ahoy_core.body.model import BodyModel
from ahoy_core.body.rotations import axis_angle_to_matrix
from ahoy_core.body.shared import shared_canonical_pose


@dataclass(frozen=True)
class Kinematics:
    """The skeleton of one person: everything that a change of pose needs.

    Attributes:
        parents: Parent of each joint, -1 for the root.
        rest_joints: [1,J,3] metres, of the person's shape.
        canonical: [J,3,3] local rotations of the canonical pose.
        from_canonical: [J,4,4] canonical space -> rest space, joint by joint.
    """

    parents: tuple[int, ...]
    rest_joints: Tensor
    canonical: Tensor
    from_canonical: Tensor

    @classmethod
    def of(cls, body: BodyModel, betas: Tensor) -> Kinematics:
        """The skeleton of a body of shape betas [S]."""
        pose = shared_canonical_pose(body).to(betas)
        rest_joints = body(pose[None], betas[None], pose.new_zeros(1, 3)).rest_joints
        canonical = axis_angle_to_matrix(pose)
        start = forward_kinematics(canonical[None], rest_joints, body.parents, pose.new_zeros(1, 3))[0]
        rotation = start[:, :3, :3].transpose(-1, -2)
        shift = -(rotation @ start[:, :3, 3:])
        inverse = torch.cat([torch.cat([rotation, shift], -1), start[:, 3:]], -2)
        return cls(tuple(body.parents), rest_joints, canonical, inverse)

    @property
    def n_joints(self) -> int:
        """J."""
        return len(self.parents)

    def relative(self, rotations: Tensor, transl: Tensor) -> Tensor:
        """What takes the canonical body to poses, joint by joint: T_j(pose) T_j(canonical)^-1.

        Args:
            rotations: [B,J,3,3] local rotations, the root's in the world.
            transl: [B,3] metres, world.

        Returns:
            [B,J,4,4]; identities where the pose is the canonical one and transl is 0.
        """
        posed = forward_kinematics(rotations, self.rest_joints.to(rotations), self.parents, transl)
        return posed @ self.from_canonical.to(rotations)

    def to(self, dtype: torch.dtype) -> Kinematics:
        """The same in another precision."""
        moved = (value.to(dtype) for value in (self.rest_joints, self.canonical, self.from_canonical))
        return Kinematics(self.parents, *moved)


def relative_transforms(body: BodyModel, pose: Tensor, betas: Tensor, transl: Tensor) -> Tensor:
    """What takes the canonical body to a pose, joint by joint: T_j(pose) T_j(canonical)^-1.

    Args:
        body: The body model.
        pose: [B,J,3] axis-angle, radians.
        betas: [S] shape, the same for both.
        transl: [B,3] metres, world.

    Returns:
        [B,J,4,4]; the identity where pose is the canonical pose and transl is 0.
    """
    return Kinematics.of(body, betas.to(pose)).relative(axis_angle_to_matrix(pose), transl)
