"""SMPL parameters as a model states them -> poses of any of our bodies, without the licensed SMPL file.

What a model returns holds its own skeleton: rotations and posed joints give the joints at rest. So `convert_pose` can
carry the poses over, and a body of another family is sized by the lengths of its limbs.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
import torch
from scipy.optimize import least_squares
from torch import Tensor

from ahoy_core.body.convert import Skeleton, SkeletonPose, body_skeleton, convert_pose, joint_map
from ahoy_core.body.lbs import global_rotations
from ahoy_core.body.model import BodyModel
from ahoy_core.body.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from ahoy_core.body.smpl_names import JOINT_NAMES, is_limb, smpl_parents
from ahoy_core.conventions import OBSERVED_VIEWMAT
from ahoy_core.models.contracts import PoseEstimate

# The family's files are y up and face +z; ours are z up and face -y.
_FROM_FILE: Final = ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0))
_PULL: Final = 0.05  # of shape parameters to an average adult, against relative errors of limb lengths
_BONE: Final = 0.15  # metres: shorter ones (fingers) say little of a person's size, and there are many
_STEP: Final = 1e-3  # of shape parameters in finite differences
_RANGE: Final = (0.0, 1.0)  # of the packaged body's parameters


class Adopted(NamedTuple):
    """Poses [N,J,3] axis-angle, translations [N,3] and one shape [S] of a body of ours, in the world's axes."""

    pose: Tensor
    transl: Tensor
    betas: Tensor


def adopt(estimate: PoseEstimate, body: BodyModel) -> Adopted:
    """Carry a model's estimate over to a body.

    Rows in which nobody was found repeat their nearest neighbour's pose.

    Args:
        estimate: N frames.
        body: the body wanted.

    Raises:
        ValueError: nobody was found in any frame.
    """
    if not bool(estimate.found.any()):
        raise ValueError("expected the pose model to find the subject in some frame, got none; see its min_overlap")
    rows = _nearest(estimate.found)
    skeleton, posed = skeleton_of(estimate)
    betas = _shape(estimate, skeleton, body)
    target = body_skeleton(body, betas)
    pairs = joint_map(target.joint_names, skeleton.joint_names)
    converted = convert_pose(skeleton, target, posed, pairs, is_limb)
    transl = converted.root - target.rest_joints[0].to(converted.root)
    pose = matrix_to_axis_angle(converted.rotations)
    return Adopted(pose[rows].to(betas), transl[rows].to(betas), betas)


def skeleton_of(estimate: PoseEstimate) -> tuple[Skeleton, SkeletonPose]:
    """The skeleton that an estimate implies, at rest, and its poses, both in our axes."""
    names = JOINT_NAMES[estimate.family]
    parents = smpl_parents(names)
    turn = torch.tensor(_FROM_FILE, dtype=torch.float64)
    to_world = OBSERVED_VIEWMAT[:3, :3].double().T
    rotations = axis_angle_to_matrix(estimate.pose.double())
    ours = turn @ rotations @ turn.T
    ours[:, 0] = to_world @ rotations[:, 0] @ turn.T
    joints = estimate.joints.double() @ to_world.T
    world = global_rotations(ours, parents)
    rest = [torch.zeros(3, dtype=torch.float64)]
    found = estimate.found
    for joint, parent in enumerate(parents[1:], start=1):
        bones = (world[found, parent].transpose(1, 2) @ (joints[found, joint] - joints[found, parent])[..., None])[
            ..., 0
        ]
        rest.append(rest[parent] + bones.mean(0))
    return Skeleton(names, parents, torch.stack(rest), "T of SMPL"), SkeletonPose(ours, joints[:, 0])


def _shape(estimate: PoseEstimate, skeleton: Skeleton, body: BodyModel) -> Tensor:
    """[S]: the model's own where the body is of its family, else by limb lengths."""
    if body.joint_names == skeleton.joint_names:
        betas = torch.zeros_like(body.default_betas)
        own = estimate.betas[estimate.found].median(0).values.to(betas)
        count = min(len(betas), len(own))
        betas[:count] = own[:count]
        return betas
    return fit_shape(body, skeleton)


def fit_shape(body: BodyModel, skeleton: Skeleton) -> Tensor:
    """Shape [S] of a body whose arms and legs are as long as a skeleton's, and else an average adult's.

    Args:
        body: of another family than the skeleton.
        skeleton: at rest, metres.
    """
    pairs = joint_map(body.joint_names, skeleton.joint_names) or {}
    bones = _bones(body, skeleton, pairs)
    start = body.default_betas.double().numpy()
    wanted = np.array([float((skeleton.rest_joints[b] - skeleton.rest_joints[a]).norm()) for _, _, a, b in bones])

    def lengths(betas: np.ndarray) -> np.ndarray:
        rest = body_skeleton(body, torch.from_numpy(betas).to(body.default_betas)).rest_joints
        return np.array([float((rest[b] - rest[a]).norm()) for a, b, _, _ in bones])

    def residuals(betas: np.ndarray) -> np.ndarray:
        return np.concatenate([lengths(betas) / wanted - 1, _PULL * (betas - start)])

    if not bones:
        return body.default_betas
    inside = np.clip(start, _RANGE[0] + _STEP, _RANGE[1] - _STEP)
    found = least_squares(residuals, inside, bounds=_RANGE, diff_step=_STEP, max_nfev=5)
    return torch.from_numpy(found.x).to(body.default_betas)


def _bones(body: BodyModel, skeleton: Skeleton, pairs: dict[str, str] | object) -> list[tuple[int, int, int, int]]:
    """Limb bones that both have: body joints (start, end), skeleton joints (start, end)."""
    assert isinstance(pairs, dict)
    numbers = {body.joint_names.index(t): skeleton.joint_names.index(s) for t, s in pairs.items()}
    bones = []
    for joint, partner in numbers.items():
        above = body.parents[joint]
        while above >= 0 and above not in numbers:
            above = body.parents[above]
        if above < 0:
            continue
        length = float((skeleton.rest_joints[partner] - skeleton.rest_joints[numbers[above]]).norm())
        if length > _BONE and is_limb(body.joint_names[joint]) and is_limb(body.joint_names[above]):
            bones.append((above, joint, numbers[above], partner))
    return bones


def _nearest(found: Tensor) -> Tensor:
    """For each row, the nearest row that was found."""
    known = torch.nonzero(found).flatten()
    away = (torch.arange(len(found))[:, None] - known[None]).abs()
    return known[away.argmin(1)]
