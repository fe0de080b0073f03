"""What the fit solves for, and how landmarks and joints move with it: exact derivatives, by hand.

A joint's turn moves everything below it about that joint, so a landmark's derivative is a cross product with its
lever arm. That costs one pass for all parameters, where automatic differentiation takes one pass for each row.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ahoy_core.body.lbs import forward_kinematics
from ahoy_core.body.rotations import axis_angle_to_matrix, skew
from ahoy_core.perceive.reduced import ReducedBody

_SMALL = 1e-4  # squared radians below which a series stands in for a quotient


@dataclass(frozen=True)
class State:
    """The unknowns: N frames with P = 3F + 3 numbers each, and G = S + 1 numbers for the clip.

    Attributes:
        root: [N,3,3] first root rotations, fixed.
        angles: [N,F,3] rotation vectors: to the right of `root` for the root, from rest for the other moving joints.
        place: [N,3] root joint in the world, metres. The shape does not move it.
        betas: [S].
        log_scale: [] logarithm of the network's metre.
    """

    root: Tensor
    angles: Tensor
    place: Tensor
    betas: Tensor
    log_scale: Tensor

    def rotations(self) -> Tensor:
        """Return [N,F,3,3], relative to the moving parent; the root's in the world."""
        turned = axis_angle_to_matrix(self.angles)
        return torch.cat([(self.root @ turned[:, 0])[:, None], turned[:, 1:]], dim=1)

    def transl(self, reduced: ReducedBody) -> Tensor:
        """Return [N,3], what the body calls its translation."""
        return self.place - reduced.rest_joints(self.betas)[0]

    def posed(self, reduced: ReducedBody) -> tuple[Tensor, Tensor]:
        """Return landmarks [N,33,3] and moving joints [N,F,3], world."""
        return reduced(self.rotations(), self.transl(reduced), self.betas)

    def moved(self, frames: Tensor, clip: Tensor, beta_range: tuple[float, float] | None) -> State:
        """Add a step [N,P] and [G]; shape stays in its range."""
        n, f = self.angles.shape[:2]
        betas = self.betas + clip[:-1]
        return replace(
            self,
            angles=self.angles + frames[:, : 3 * f].reshape(n, f, 3),
            place=self.place + frames[:, 3 * f :],
            betas=betas.clamp(*beta_range) if beta_range else betas,
            log_scale=self.log_scale + clip[-1],
        )


@dataclass(frozen=True)
class Linearised:
    """Landmarks and joints with their derivatives: columns are the P numbers of the frame, then the G of the clip.

    Attributes:
        landmarks: [N,33,3] world.
        joints: [N,F,3] world.
        d_landmarks: [N,33,3,P+G].
        d_joints: [N,F,3,P+G].
    """

    landmarks: Tensor
    joints: Tensor
    d_landmarks: Tensor
    d_joints: Tensor


def linearise(reduced: ReducedBody, state: State) -> Linearised:
    """Compute landmarks, joints and their exact derivatives at a state."""
    rest = reduced.rest_joints(state.betas)
    moments = reduced.shaped_moments(state.betas)
    rotations = state.rotations()
    transforms = forward_kinematics(rotations, rest[None], reduced.parents, state.transl(reduced))[:, :, :3]
    turned = transforms[..., :3]
    joints = (turned @ rest[..., None])[..., 0] + transforms[..., 3]
    parts = torch.einsum("nfij,kfj->nkfi", transforms, moments)
    under = below(reduced.parents).to(rest)
    share = moments[..., 3] @ under.T
    lever = torch.einsum("fg,nkgi->nkfi", under, parts) - share[None, :, :, None] * joints[:, None]
    joint_lever = (joints[:, :, None] - joints[:, None]) * under.T[None, :, :, None]
    turning = turned @ right_jacobian(state.angles)
    landmarks_by_shape, joints_by_shape = _by_shape(reduced, rotations, moments[..., 3])
    return Linearised(
        landmarks=parts.sum(2),
        joints=joints,
        d_landmarks=_columns(lever, turning, landmarks_by_shape),
        d_joints=_columns(joint_lever, turning, joints_by_shape),
    )


def right_jacobian(angles: Tensor) -> Tensor:
    """J [...,3,3] with R(a + d) = R(a) exp(J d) to first order, for rotation vectors a [...,3]."""
    square = (angles * angles).sum(-1)[..., None, None]
    small = square < _SMALL
    angle = torch.where(small, torch.ones_like(square), square).sqrt()
    first = torch.where(small, 0.5 - square / 24, (1 - torch.cos(angle)) / angle**2)
    second = torch.where(small, 1 / 6 - square / 120, (angle - torch.sin(angle)) / angle**3)
    K = skew(angles)
    return torch.eye(3).to(angles) - first * K + second * (K @ K)


def _columns(lever: Tensor, turning: Tensor, by_shape: Tensor) -> Tensor:
    """Put together d point [N,K,3,P+G] from lever arms [N,K,F,3], axes [N,F,3,3] and shape derivatives [N,K,3,S]."""
    n, k, f = lever.shape[:3]
    by_angles = (-skew(lever) @ turning[:, None]).permute(0, 1, 3, 2, 4).reshape(n, k, 3, 3 * f)
    by_place = torch.eye(3).to(lever).expand(n, k, 3, 3)
    return torch.cat([by_angles, by_place, by_shape, lever.new_zeros(n, k, 3, 1)], dim=-1)


def _by_shape(reduced: ReducedBody, rotations: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Derivatives of landmarks [N,33,3,S] and joints [N,F,3,S] by betas with the root joint held: linear in them."""
    landmarks, joints = [], []
    for moment, rest, moved in zip(
        reduced.moment_slopes, reduced.joint_slopes, moved_by_shape(reduced, rotations), strict=True
    ):
        joints.append((moved[..., :3] @ rest[..., None])[..., 0] + moved[..., 3])
        turned = torch.einsum("nfij,kfj->nki", moved[..., :3], moment[..., :3])
        landmarks.append(turned + torch.einsum("nfi,kf->nki", moved[..., 3], weights))
    return torch.stack(landmarks, -1), torch.stack(joints, -1)


def moved_by_shape(reduced: ReducedBody, rotations: Tensor) -> list[Tensor]:
    """Joints' transforms [N,F,3,4] of each beta's slope alone, the root joint held: posing is linear in betas."""
    return [
        forward_kinematics(rotations, rest[None], reduced.parents, -rest[:1].expand(len(rotations), -1))[:, :, :3]
        for rest in reduced.joint_slopes
    ]


def below(parents: tuple[int, ...]) -> Tensor:
    """[F,F] bool: column joint is the row joint or below it."""
    result = torch.eye(len(parents), dtype=torch.bool)
    for joint in range(len(parents) - 1, 0, -1):
        result[parents[joint]] |= result[joint]
    return result
