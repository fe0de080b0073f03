"""True bodies given as parameters of the SMPL family, turned into this project's axes.

A data set's world may be any: it is turned as SMPL's own rest space is (its y becomes our z), and cameras with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from ahoy_core.body.convert import SkeletonPose
from ahoy_core.body.rotations import axis_angle_to_matrix
from ahoy_core.body.smpl_load import load_smpl
from ahoy_core.captures.capture import BodyTruth
from ahoy_core.conventions import Cameras
from ahoy_core.motion.smpl import SMPL_AXES, SMPL_PELVIS, smpl_skeleton

AVERAGE_PELVIS = (
    "the true root stands where the average body's pelvis is: up to some centimetres off for other shapes; give the "
    "body that the parameters belong to (--truth-body)"
)


def pelvis(betas: Tensor, body: Path | None) -> Tensor:
    """[3] the root joint in SMPL's own rest space (y up), metres: of the shape, or of the average without a body file.

    Args:
        betas: [S] shape.
        body: the user's `.npz` of the body that the parameters belong to.
    """
    if body is None:
        return torch.tensor(SMPL_PELVIS, dtype=torch.float64)
    model = load_smpl(body, n_betas=len(betas), dtype=torch.float64)
    joints = model.shape(betas.double()[None, : model.n_betas])[1]
    return SMPL_AXES.T @ joints[0, 0]


def smpl_truth(poses: Tensor, root: Tensor, frames: Sequence[int]) -> BodyTruth:
    """A body truth from SMPL parameters.

    Args:
        poses: [T,J,3] axis-angle of 22, 24, 52 or 55 joints, in the file's axes; the root's in the data set's world.
        root: [T,3] the root joint in the data set's world, metres.
        frames: number of each row.

    Raises:
        ValueError: another number of joints, or rows that do not match.
    """
    if not len(poses) == len(root) == len(frames):
        raise ValueError(f"expected one pose and place a frame, got {len(poses)}, {len(root)}, {len(frames)}")
    turned = SMPL_AXES @ axis_angle_to_matrix(poses.double()) @ SMPL_AXES.T
    return BodyTruth(
        smpl_skeleton(poses.shape[1]), SkeletonPose(turned, root.double() @ SMPL_AXES.T), tuple(map(int, frames))
    )


def turned_camera(camera: Cameras) -> Cameras:
    """A camera of the data set's world before the world turned by `SMPL_AXES`."""
    turn = torch.eye(4, dtype=torch.float64)
    turn[:3, :3] = SMPL_AXES.T
    viewmats = (camera.viewmats.double() @ turn).float()
    return Cameras(viewmats, camera.Ks, camera.width, camera.height, camera.camera_model)
