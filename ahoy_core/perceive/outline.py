"""The body's outline against the masks': distances along the outline's normal, and their derivatives by hand.

A place slides along the outline at no cost, so only what an outline can show is measured: how far it lies inside or
outside.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ahoy_core.body.lbs import forward_kinematics
from ahoy_core.perceive.reduced import ReducedBody
from ahoy_core.perceive.residuals import image_derivatives, safe_depth
from ahoy_core.perceive.state import State, below, moved_by_shape, right_jacobian

# Metres. Clothes stand off the skin, masks are some pixels wrong, and neighbouring places err together.
OUTLINE_SPREAD = 0.03
OUTLINE_SCALE = 0.04  # metres: width of Geman-McClure


@dataclass(frozen=True)
class Outline:
    """Places on the bodies' outlines and the masks' edges across from them.

    Attributes:
        vertices: [N,K] int64.
        targets: [N,K,2] pixels.
        normals: [N,K,2] unit vectors out of the body, in pixels (y down).
        weights: [N,K] in [0,1]; 0 where there is no such place, or its edge is not certain.
    """

    vertices: Tensor
    targets: Tensor
    normals: Tensor
    weights: Tensor


def outline_offsets(reduced: ReducedBody, state: State, outline: Outline, K: Tensor, person: Tensor) -> Tensor:
    """Distances [N,K] in metres at the person's depth by which places lie outside (positive) of the masks' edges.

    Args:
        reduced: the body.
        state: where to evaluate.
        outline: the places.
        K: [3,3] pixels.
        person: [N] metres, see `residuals.person_depth`.
    """
    return _offsets(_parts(reduced, state, outline)[0].sum(2), outline, K, person)


def outline_rows(
    reduced: ReducedBody, state: State, outline: Outline, K: Tensor, person: Tensor
) -> tuple[Tensor, Tensor]:
    """`outline_offsets` and their derivatives [N,K,P+G], columns as in `state.Linearised`."""
    parts, transforms, weights = _parts(reduced, state, outline)
    points = parts.sum(2)
    offsets = _offsets(points, outline, K, person)
    pull = (_normals(outline, K)[..., None, :] @ image_derivatives(points, person))[..., 0, :]
    turned, rest = transforms[..., :3], reduced.rest_joints(state.betas)
    joints = (turned @ rest[..., None])[..., 0] + transforms[..., 3]
    under = below(reduced.parents).to(rest)
    lever = torch.einsum("fg,nkgi->nkfi", under, parts) - (weights @ under.T)[..., None] * joints[:, None]
    # pull . (turn x lever) = turn . (lever x pull)
    torque = torch.linalg.cross(lever, pull[:, :, None].expand_as(lever))
    by_angles = torch.einsum("nkfi,nfij->nkfj", torque, turned @ right_jacobian(state.angles)).flatten(2)
    by_shape = []
    moves = zip(reduced.surface_slopes, moved_by_shape(reduced, state.rotations()), strict=True)
    for slope, moved in moves:
        shifted = torch.einsum("nkf,nfij,nkj->nki", weights, moved[..., :3], slope[outline.vertices])
        shifted = shifted + torch.einsum("nkf,nfi->nki", weights, moved[..., 3])
        by_shape.append((pull * shifted).sum(-1))
    rows = [by_angles, pull, torch.stack(by_shape, -1), pull.new_zeros(*pull.shape[:2], 1)]
    return offsets, torch.cat(rows, dim=-1)


def _parts(reduced: ReducedBody, state: State, outline: Outline) -> tuple[Tensor, Tensor, Tensor]:
    """Each joint's share of each place [N,K,F,3], the joints' transforms [N,F,3,4] and the weights [N,K,F]."""
    betas = state.betas
    rest = reduced.surface[outline.vertices] + torch.einsum(
        "s,snkc->nkc", betas - reduced.base_betas, reduced.surface_slopes[:, outline.vertices]
    )
    weights = reduced.skin[outline.vertices]
    transforms = forward_kinematics(
        state.rotations(), reduced.rest_joints(betas)[None], reduced.parents, state.transl(reduced)
    )[:, :, :3]
    moved = torch.einsum("nfij,nkj->nkfi", transforms[..., :3], rest) + transforms[:, None, ..., 3]
    return weights[..., None] * moved, transforms, weights


def _normals(outline: Outline, K: Tensor) -> Tensor:
    """Normals [N,K,2] for offsets on the plane at depth 1: a covector, so focal lengths multiply; unit length."""
    return torch.nn.functional.normalize(outline.normals * torch.stack([K[0, 0], K[1, 1]]), dim=-1)


def _offsets(points: Tensor, outline: Outline, K: Tensor, person: Tensor) -> Tensor:
    plane = torch.stack([points[..., 0], -points[..., 2]], dim=-1) / safe_depth(points[..., 1])[..., None]
    rays = (outline.targets - K[:2, 2]) / torch.stack([K[0, 0], K[1, 1]])
    return ((plane - rays) * _normals(outline, K)).sum(-1) * person[:, None]
