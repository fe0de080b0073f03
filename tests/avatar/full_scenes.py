"""Small scenes for the full avatar: sequences and face views rendered from the dressed template."""

from __future__ import annotations

import math
from functools import cache

import torch
from torch import Tensor

from ahoy_core.avatar.coarse import textured_template
from ahoy_core.avatar.deform import deform, dense_weights
from ahoy_core.avatar.full_config import FullConfig
from ahoy_core.avatar.full_inputs import FullInputs
from ahoy_core.avatar.hallucinated import Supervision
from ahoy_core.avatar.head import FaceViews
from ahoy_core.avatar.kinematics import Kinematics
from ahoy_core.avatar.render import Rendered, render
from ahoy_core.body.canonical import canonical_pose
from ahoy_core.body.rotations import axis_angle_to_matrix
from ahoy_core.conventions import Cameras, turntable_cameras
from tests.avatar.scenes import body, canonical_covars, coarse_inputs, dressed

SIZE = 48
TINY_FULL = FullConfig(
    map_reduction=1,
    width=8,
    steps=20,
    sequences_per_step=1,
    shots_per_sequence=2,
    frames_per_step=1,
    faces_per_step=1,
    observed_map_poses=2,
    check_every=10,
    patch=32,
)


@cache
def kinematics() -> Kinematics:
    """The skeleton of the default shape."""
    return Kinematics.of(body(), body().default_betas)


def raised(angle: float) -> Tensor:
    """The canonical pose [J,3] with the left upper arm turned by an angle about y."""
    pose = canonical_pose(body()).clone()
    pose[body().joint_names.index("upperarm01.L"), 1] -= angle
    return pose


def around(count: int) -> Cameras:
    """Cameras round the canonical body."""
    center = (dressed().means.amin(0) + dressed().means.amax(0)) / 2
    return turntable_cameras(center, 4.0, count, 0.0, SIZE, SIZE, SIZE * 1.9)


def seen(pose: Tensor, cameras: Cameras) -> Rendered:
    """The dressed template in a pose."""
    truth = dressed()
    relative = kinematics().relative(axis_angle_to_matrix(pose)[None], torch.zeros(1, 3))[0]
    weights = dense_weights(truth.skin_indices, truth.skin_weights, body().n_joints)
    means, covars = deform(truth.means, canonical_covars(truth), weights, relative)
    return render(means, covars, truth.opacities, truth.colors, cameras)


@cache
def sequence(angle: float = 0.0, views: int = 3, factor: int = 1) -> Supervision:
    """One pose from some sides; smaller than its cameras by a factor."""
    cameras = around(views)
    image, alpha = (torch.nn.functional.avg_pool2d(x, factor) for x in seen(raised(angle), cameras))
    return Supervision(
        name=f"raised {angle}",
        kind="static",
        frames=image.clamp(0, 1),
        coverage=torch.zeros_like(alpha[:, 0]),
        map_pose=raised(angle),
        pose=raised(angle).expand(views, -1, -1),
        transl=torch.zeros(views, 3),
        cameras=cameras,
        alphas=alpha[:, 0],
    )


@cache
def faces(count: int = 2) -> FaceViews:
    """The dressed head alone, in the canonical head frame, from orthogonal sides."""
    truth, head = dressed(), dressed().head
    center = truth.means[head].mean(0)
    cameras = turntable_cameras(center, 1.0, count, 0.0, 32, 32, 70.0)
    image, alpha = render(
        truth.means[head], canonical_covars(truth)[head], truth.opacities[head], truth.colors[head], cameras
    )
    return FaceViews(
        images=image,
        alphas=alpha[:, 0],
        weights=torch.ones_like(alpha[:, 0]),
        cameras=cameras,
        relative=torch.eye(4).expand(count, body().n_joints, 4, 4),
        expression=torch.zeros(count, body().n_expressions),
        shares=torch.ones(count),
    )


@cache
def full_inputs(with_faces: bool = True) -> FullInputs:
    """Observed frames, two sequences and face views of one person; the template knows only grey."""
    observed = coarse_inputs()
    return FullInputs(
        observed=observed,
        template=textured_template(observed, 32),
        sequences=(sequence(0.0), sequence(math.radians(40))),
        faces=faces() if with_faces else None,
    )
