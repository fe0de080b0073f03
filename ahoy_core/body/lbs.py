"""Linear blend skinning and forward kinematics (paper, section 3.1: Gaussians follow the body by LBS)."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import torch
from torch import Tensor


def normalize_weights(lbs_weights: Tensor) -> Tensor:
    """Skin weights [...,J] >= 0 with rows that sum to 1; a row that sums to (next to) nothing follows the root.

    Files are rounded, networks start anywhere: a row of zeros would drag its point to the world's origin. Gradients are
    finite in every row and zero in rows of zeros.
    """
    tiny = torch.finfo(lbs_weights.dtype).tiny ** 0.5  # its square, which the gradient divides by, is still normal
    total = lbs_weights.sum(-1, keepdim=True)
    empty = total <= tiny
    root = torch.zeros_like(lbs_weights)
    root[..., 0] = 1
    return torch.where(empty, root, lbs_weights / torch.where(empty, torch.ones_like(total), total))


def blend_transforms(lbs_weights: Tensor, transforms: Tensor) -> Tensor:
    """Blends joint transforms by skin weights: sum_j w_nj T_bj.

    Args:
        lbs_weights: [N,J] or [B,N,J], rows sum to 1.
        transforms: [B,J,4,4] rest space -> world.

    Returns:
        [B,N,4,4]. Their linear part is not a rotation where bones disagree.

    Raises:
        ValueError: when the number of joints differs.
    """
    if transforms.ndim != 4 or transforms.shape[2:] != (4, 4) or lbs_weights.shape[-1] != transforms.shape[1]:
        raise ValueError(
            f"expected lbs_weights [N,J] and transforms [B,J,4,4] with one J, got {tuple(lbs_weights.shape)} and "
            f"{tuple(transforms.shape)}; use the weights of the body that made the transforms"
        )
    top = lbs_weights @ transforms[:, :, :3].flatten(2)
    top = top.unflatten(-1, (3, 4))
    bottom = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=top.dtype, device=top.device).expand(*top.shape[:2], 1, 4)
    return torch.cat([top, bottom], dim=-2)


def lbs(points: Tensor, lbs_weights: Tensor, transforms: Tensor) -> Tensor:
    """Skins points of rest space.

    Args:
        points: [N,3] or [B,N,3] metres, rest space.
        lbs_weights: [N,J] or [B,N,J], rows sum to 1.
        transforms: [B,J,4,4] rest space -> world.

    Returns:
        [B,N,3] metres, world.
    """
    blended = lbs_weights @ transforms[:, :, :3].flatten(2)
    blended = blended.unflatten(-1, (3, 4))
    return (blended[..., :3] @ points[..., None])[..., 0] + blended[..., 3]


def depth_levels(parents: Sequence[int]) -> list[list[int]]:
    """Joints by depth below the root, so that a whole level can be computed at once.

    Raises:
        ValueError: unless joint 0 is the only root and parents come before their children.
    """
    if not parents or parents[0] != -1 or any(not 0 <= p < j for j, p in enumerate(parents) if j):
        raise ValueError(f"expected one root (-1) at index 0 and parents before children, got {list(parents)[:8]}...")
    depth = [0] * len(parents)
    for joint, parent in enumerate(parents):
        depth[joint] = 0 if parent < 0 else depth[parent] + 1
    return [[j for j, d in enumerate(depth) if d == level] for level in range(max(depth) + 1)]


def global_rotations(rotations: Tensor, parents: Sequence[int]) -> Tensor:
    """Chains local rotations [B,J,3,3] down the tree: G_c = G_parent R_c, in the axes of rest space."""
    return _chain(rotations, None, parents)[0]


def local_rotations(globals_: Tensor, parents: Sequence[int]) -> Tensor:
    """The inverse of `global_rotations`: R_c = G_parent^T G_c, [B,J,3,3]."""
    index = torch.tensor([max(p, 0) for p in parents], device=globals_.device)
    local = globals_[:, index].transpose(-1, -2) @ globals_
    return torch.cat([globals_[:, :1], local[:, 1:]], dim=1)


def forward_kinematics(rotations: Tensor, rest_joints: Tensor, parents: Sequence[int], transl: Tensor) -> Tensor:
    """World transforms of the joints.

    Rotations are expressed in the axes of rest space: a joint's world rotation is its parent's times its own, and the
    root turns about its rest position.

    Args:
        rotations: [B,J,3,3] relative to the parent; the root's in the world.
        rest_joints: [B,J,3] or [1,J,3] metres.
        parents: -1 for the root at index 0, parents before children.
        transl: [B,3] metres, added to everything.

    Returns:
        [B,J,4,4] rest space -> world, so that identity rotations and zero `transl` give identities.
    """
    turned, joints = _chain(rotations, rest_joints.expand(len(rotations), -1, -1), parents)
    assert joints is not None
    shift = joints + transl[:, None] - (turned @ rest_joints[..., None])[..., 0]
    top = torch.cat([turned, shift[..., None]], dim=-1)
    bottom = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=top.dtype, device=top.device).expand(*top.shape[:2], 1, 4)
    return torch.cat([top, bottom], dim=-2)


def _chain(rotations: Tensor, rest_joints: Tensor | None, parents: Sequence[int]) -> tuple[Tensor, Tensor | None]:
    """World rotations and, given rest joints, joint positions, one product per depth level."""
    levels = depth_levels(parents)
    turned, placed = [rotations[:, :1]], [rest_joints[:, :1]] if rest_joints is not None else None
    for above, level in itertools.pairwise(levels):
        rows = [above.index(parents[j]) for j in level]
        parent_turn = turned[-1][:, rows]
        turned.append(parent_turn @ rotations[:, level])
        if placed is not None and rest_joints is not None:
            offset = rest_joints[:, level] - rest_joints[:, [parents[j] for j in level]]
            placed.append(placed[-1][:, rows] + (parent_turn @ offset[..., None])[..., 0])
    order = [j for level in levels for j in level]
    inverse = sorted(range(len(order)), key=order.__getitem__)
    return torch.cat(turned, 1)[:, inverse], torch.cat(placed, 1)[:, inverse] if placed is not None else None
