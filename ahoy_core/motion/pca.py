"""Poses kept near those that an avatar was trained on, by principal components (paper section 3.4).

Rotations are represented by two columns of their matrix, which is continuous, where axis-angle jumps at half turns
(Zhou et al., On the Continuity of Rotation Representations, CVPR 2019). Coefficients are clamped to a number of
standard deviations, as in Animatable Gaussians. The root's orientation is left alone: which way a person faces says
nothing about the pose.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ahoy_core.body.rotations import axis_angle_to_matrix, geodesic_distance, matrix_to_axis_angle
from ahoy_core.motion.motion import Motion
from ahoy_core.motion.time import slerp

# Directions with less than this share of the largest deviation are rounding errors, not poses.
_RANK_TOLERANCE = 1e-5


@dataclass(frozen=True)
class PosePca:
    """What a set of training poses spans.

    Attributes:
        mean: [6(J-1)].
        components: [R,6(J-1)] orthonormal rows; R = 0 for a single pose.
        deviations: [R] standard deviations along them, descending.
    """

    mean: Tensor
    components: Tensor
    deviations: Tensor


def fit_pose_pca(training_poses: Tensor, n_components: int = 20) -> PosePca:
    """Principal components of poses.

    Args:
        training_poses: [T,J,3] axis-angle.
        n_components: At most this many; fewer if the poses span fewer.

    Raises:
        ValueError: If there is no pose, or one is not finite.
    """
    if len(training_poses) == 0 or not bool(torch.isfinite(training_poses).all()):
        raise ValueError(f"expected finite training poses, got {tuple(training_poses.shape)}; leave bad frames out")
    flat = _columns(axis_angle_to_matrix(training_poses.double())[:, 1:])
    mean = flat.mean(0)
    _, values, rows = torch.linalg.svd(flat - mean, full_matrices=False)
    deviations = values / max(1, len(flat) - 1) ** 0.5
    # Absolute as well: poses that are all the same differ by rounding alone.
    kept = deviations > max(_RANK_TOLERANCE * float(deviations.max()), 1e-9)
    count = min(int(kept.sum()), n_components)
    return PosePca(mean, rows[:count], deviations[:count])


def project_pose(pca: PosePca, pose: Tensor, strength: float = 1.0, max_deviations: float = 2.0) -> Tensor:
    """Poses pulled towards the training distribution.

    Args:
        pca: From `fit_pose_pca`.
        pose: [T,J,3] axis-angle.
        strength: 0 leaves poses as they are, 1 puts them into the span; between, part of the way along the shortest
            rotation (of which there are two where a joint is half a turn away).
        max_deviations: Coefficients are clamped to this many standard deviations.

    Returns:
        [T,J,3]; the root is unchanged.

    Raises:
        ValueError: If the strength is outside [0,1] or the bound is not positive.
    """
    if not 0 <= strength <= 1 or not max_deviations > 0:
        raise ValueError(f"expected a strength in [0,1] and a positive bound, got {strength} and {max_deviations}")
    if strength == 0:
        return pose
    rotations = axis_angle_to_matrix(pose.double())
    own = rotations[:, 1:]
    offsets = _columns(own) - pca.mean
    bound = max_deviations * pca.deviations
    coefficients = torch.minimum(torch.maximum(offsets @ pca.components.T, -bound), bound)
    near = _matrices(pca.mean + coefficients @ pca.components)
    pulled = slerp(own, near, torch.full(own.shape[:2], strength, dtype=own.dtype))
    return matrix_to_axis_angle(torch.cat([rotations[:, :1], pulled], 1)).to(pose)


def projected_motion(motion: Motion, training_poses: Tensor, strength: float) -> tuple[Motion, Tensor]:
    """A motion pulled towards the training poses, and how far: [T] mean angle over the joints, radians."""
    pose = project_pose(fit_pose_pca(training_poses), motion.pose, strength)
    moved = replace(motion, pose=pose)
    return moved, geodesic_distance(motion.rotations()[:, 1:], moved.rotations()[:, 1:]).mean(1)


def _columns(rotations: Tensor) -> Tensor:
    """[T,J,3,3] -> [T,6J]: the first two columns of each."""
    return rotations[..., :2].transpose(-1, -2).flatten(1)


def _matrices(flat: Tensor) -> Tensor:
    """[T,6J] -> nearest-by-Gram-Schmidt rotations [T,J,3,3]; columns of means are shorter than 1 but never parallel."""
    columns = flat.unflatten(1, (-1, 2, 3))
    first = torch.nn.functional.normalize(columns[:, :, 0], dim=-1)
    second = columns[:, :, 1] - (first * columns[:, :, 1]).sum(-1, keepdim=True) * first
    second = torch.nn.functional.normalize(second, dim=-1)
    return torch.stack([first, second, torch.linalg.cross(first, second)], -1)
