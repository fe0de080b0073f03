"""The head path: which pixels and Gaussians are head, how expression moves them, what a face view is (section 3.3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor
from torch.nn.functional import pad

from ahoy_core.avatar.deform import deform, dense_weights
from ahoy_core.avatar.kinematics import Kinematics
from ahoy_core.avatar.render import render
from ahoy_core.body.model import BodyModel
from ahoy_core.body.shared import shared_canonical_pose
from ahoy_core.conventions import GREY, Cameras
from ahoy_core.maps.template import Template

HEAD_REACH = 0.12
"""Metres round the bare head that still count as head where nothing else of the body is nearer: hair, a hat."""
_SHOWN = 0.5


@dataclass(frozen=True)
class FaceViews:
    """P pictures of the head from known cameras (equation 8).

    Attributes:
        images: [P,3,h,w] sRGB over grey.
        alphas: [P,h,w] alpha of the head, [0,1].
        weights: [P,h,w] which pixels count: not those of the neck's cut, nor what hides the head.
        cameras: P cameras.
        relative: [P,J,4,4] canonical -> the cameras' space; identities for cameras in the canonical head frame.
        expression: [P,E] face actions.
        shares: [P] of the head's weight that each gets: less than 1 where it counts a second time what another loss
            counts.
    """

    images: Tensor
    alphas: Tensor
    weights: Tensor
    cameras: Cameras
    relative: Tensor
    expression: Tensor
    shares: Tensor

    def __post_init__(self) -> None:
        count, size = len(self.images), self.images.shape[2:]
        if self.alphas.shape != (count, *size) or self.weights.shape != (count, *size) or len(self.cameras) != count:
            raise ValueError(
                f"expected alphas, weights {(count, *size)} and {count} cameras to match the images, got "
                f"{tuple(self.alphas.shape)}, {tuple(self.weights.shape)} and {len(self.cameras)}"
            )
        if any(len(rows) != count for rows in (self.relative, self.expression, self.shares)):
            raise ValueError(f"expected {count} transforms, expressions and shares, one a face view")

    def __len__(self) -> int:
        return len(self.images)


def join_faces(first: FaceViews, second: FaceViews) -> FaceViews:
    """Two sets as one. A view drawn from it gives each set the weight that a view drawn from that set alone gives it.

    Args:
        first: Its cameras' model holds for both.
        second: Smaller pictures are padded on the right and below, without weight.
    """
    count = len(first) + len(second)
    width, height = (max(getattr(s.cameras, side) for s in (first, second)) for side in ("width", "height"))
    parts = []
    for views in (first, second):
        beside = (0, width - views.cameras.width, 0, height - views.cameras.height)
        maps = (pad(views.alphas, beside), pad(views.weights, beside))
        shares = views.shares * count / len(views)
        placed = (views.cameras.viewmats, views.cameras.Ks, views.relative, views.expression)
        parts.append((pad(views.images, beside, value=GREY), *maps, *placed, shares))
    images, alphas, weights, viewmats, Ks, relative, expression, shares = (
        torch.cat(pair) for pair in zip(*parts, strict=True)
    )
    cameras = Cameras(viewmats, Ks, width, height, first.cameras.camera_model)
    return FaceViews(images, alphas, weights, cameras, relative, expression, shares)


@torch.no_grad()
def expression_basis(body: BodyModel, betas: Tensor, template: Template) -> Tensor:
    """How far a full face action moves each Gaussian of the head in the canonical pose: [E,N,3] metres.

    Linear in the actions, as the bodies' expressions are; zero away from the head. FLAME's expressions come the same
    way, through the body that holds them.
    """
    count = body.n_expressions
    pose, nothing = shared_canonical_pose(body).to(betas).expand(count + 1, -1, -1), betas.new_zeros(count + 1, 3)
    actions = torch.cat([betas.new_zeros(1, count), torch.eye(count).to(betas)])
    vertices = body(pose, betas[None], nothing, actions).vertices
    moved = (vertices[1:] - vertices[0])[:, body.faces[template.faces]]
    return (moved * template.barycentric[:, :, None]).sum(2) * template.head[:, None]


@torch.no_grad()
def body_shares(template: Template, relative: Tensor, cameras: Cameras) -> Tensor:
    """Share of head and of other body in each pixel, nearest surface first: [C,2,H,W].

    Args:
        template: The bare body.
        relative: [J,4,4] from `Kinematics.relative`.
        cameras: C cameras.
    """
    half = template.rotations * template.scales[:, None, :]
    weights = dense_weights(template.skin_indices, template.skin_weights, len(relative))
    means, covars = deform(template.means, half @ half.transpose(1, 2), weights, relative)
    head = template.head.to(means)
    colors = torch.stack([head, 1 - head, torch.zeros_like(head)], 1)
    return render(means, covars, template.opacities, colors, cameras, background=0.0).images[:, :2]


def head_zone(shares: Tensor, reach: float) -> Tensor:
    """Pixels that belong to the head: nearer to the bare head than to the rest of the body, within reach.

    Args:
        shares: [2,H,W] head and other, from `body_shares`.
        reach: Pixels.

    Returns:
        [H,W] float, 0 or 1.
    """
    head, other = (shares[k].numpy() > _SHOWN for k in (0, 1))
    if not head.any():
        return torch.zeros(shares.shape[1:])
    to_head = distance_transform_edt(~head)
    to_other = distance_transform_edt(~other) if other.any() else np.full(head.shape, np.inf)
    return torch.from_numpy(((to_head < to_other) & (to_head <= reach)).astype(np.float32))


def head_reach(kinematics: Kinematics, template: Template, relative: Tensor, camera: Cameras) -> float:
    """`HEAD_REACH` in pixels of a camera."""
    joint = head_joint(template, kinematics.n_joints)
    center = relative[joint, :3, :3] @ template.means[template.head].mean(0) + relative[joint, :3, 3]
    depth = float((camera.viewmats[0, 2, :3] @ center.to(camera.viewmats) + camera.viewmats[0, 2, 3]).clamp(min=0.1))
    return HEAD_REACH * float(camera.Ks[0, 0, 0]) / (1.0 if camera.camera_model == "ortho" else depth)


def head_joint(template: Template, n_joints: int) -> int:
    """The joint that carries most of the head's Gaussians."""
    weights = dense_weights(template.skin_indices, template.skin_weights, n_joints)
    return int(weights[template.head].sum(0).argmax())
