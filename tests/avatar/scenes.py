"""Small scenes on the packaged body, for tests of maps, avatar and animation."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import torch
from torch import Tensor

from ahoy_core.avatar import CoarseConfig, CoarseInputs
from ahoy_core.avatar.deform import deform, dense_weights
from ahoy_core.avatar.kinematics import relative_transforms
from ahoy_core.avatar.render import render
from ahoy_core.body.canonical import canonical_pose
from ahoy_core.body.model import BodyModel
from ahoy_core.body.packaged import load_packaged_body
from ahoy_core.body.rotations import axis_angle_to_matrix
from ahoy_core.conventions import OBSERVED_VIEWMAT, Cameras, canonical_cameras, perspective_K
from ahoy_core.maps.template import Template, build_template

TINY = CoarseConfig(map_size=32, width=8, steps=30, check_every=10, learning_rate=1e-2)


@cache
def body() -> BodyModel:
    """The packaged body, loaded once."""
    return load_packaged_body()


@cache
def template(map_size: int = 32) -> Template:
    """The grey template of the default shape."""
    return build_template(body(), body().default_betas, map_size)


def dressed(map_size: int = 32) -> Template:
    """A template with a red top, blue trousers and a light head."""
    bare = template(map_size)
    height = bare.means[:, 2:]
    low, high = height.min(), height.max()
    share = (height - low) / (high - low)
    top, legs, head = (torch.tensor(c) for c in ((0.8, 0.1, 0.1), (0.1, 0.2, 0.7), (0.9, 0.7, 0.6)))
    colors = torch.where(share > 0.86, head, torch.where(share > 0.5, top, legs))
    return bare.paint(colors, torch.ones(len(bare)))


def poses(count: int) -> tuple[Tensor, Tensor]:
    """Canonical poses with the root turned a little, 4 m before the observed camera: [T,J,3], [T,3]."""
    pose = canonical_pose(body()).expand(count, -1, -1).clone()
    pose[:, 0, 2] += torch.linspace(-0.5, 0.5, count)
    return pose, torch.tensor([[0.0, 4.0, -0.9]]).expand(count, 3).clone()


@cache
def coarse_inputs(count: int = 6, size: int = 48) -> CoarseInputs:
    """Frames and canonical views of the dressed template; the atlas knows only grey: there is something to learn."""
    truth = dressed()
    pose, transl = poses(count)
    covars = canonical_covars(truth)
    K = perspective_K(math.radians(35), size, size)
    observed = Cameras(OBSERVED_VIEWMAT[None], K[None], size, size)
    weights = dense_weights(truth.skin_indices, truth.skin_weights, body().n_joints)
    frames, masks = [], []
    for relative in relative_transforms(body(), pose, body().default_betas, transl):
        image, alpha = render(*deform(truth.means, covars, weights, relative), truth.opacities, truth.colors, observed)
        frames.append(image[0])
        masks.append(alpha[0, 0])
    views = canonical_cameras(truth.means, size, size)
    image, alpha = render(truth.means, covars, truth.opacities, truth.colors, views)
    return CoarseInputs(
        body=body(),
        betas=body().default_betas,
        pose=pose,
        transl=transl,
        frames=torch.stack(frames),
        masks=torch.stack(masks),
        silhouettes=torch.stack(masks),
        viewmat=OBSERVED_VIEWMAT,
        K=K,
        used=torch.ones(count, dtype=torch.bool),
        confidence=torch.ones(count),
        views=torch.cat([image, alpha], 1).clamp(0, 1),
        view_coverage=torch.zeros(4, size, size),
        view_cameras=views,
        atlas=torch.full((3, 16, 16), 0.5),
        atlas_coverage=torch.zeros(16, 16),
    )


def canonical_covars(of: Template) -> Tensor:
    """[N,3,3] covariances of a template."""
    half = of.rotations * of.scales[:, None]
    return half @ half.transpose(1, 2)


def hand_made(count: int = 5, joints: int = 3, seed: int = 0) -> Template:
    """A float64 template of a few Gaussians near the origin, with two joints each."""
    g = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=g, dtype=torch.float64)

    weights = uniform(count, 2) + 0.2
    return Template(
        map_size=16,
        pitch=0.1,
        pixels=torch.stack([torch.zeros(count), torch.arange(count), torch.zeros(count)], 1).long(),
        means=uniform(count, 3) - 0.5,
        rotations=axis_angle_to_matrix(uniform(count, 3)),
        scales=0.1 + 0.1 * uniform(count, 3),
        opacities=0.3 + 0.4 * uniform(count),
        colors=uniform(count, 3),
        observed=uniform(count),
        faces=torch.zeros(count, dtype=torch.int64),
        barycentric=torch.full((count, 3), 1 / 3, dtype=torch.float64),
        uv=uniform(count, 2),
        skin_indices=torch.stack([torch.arange(count) % joints, (torch.arange(count) + 1) % joints], 1),
        skin_weights=weights / weights.sum(1, keepdim=True),
        head=torch.zeros(count, dtype=torch.bool),
        areas=torch.ones(count, dtype=torch.float64),
    )


def with_frames(inputs: CoarseInputs, **changes: Tensor) -> CoarseInputs:
    """The same inputs with some fields replaced."""
    return replace(inputs, **changes)
