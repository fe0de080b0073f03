"""What every `BodyModel` does alike: check its arguments, skin a shaped rest body, move to another device."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import Any, TypeVar

import torch
from torch import Tensor

from ahoy_core.body.lbs import forward_kinematics, lbs
from ahoy_core.body.model import BodyModel, BodyOutput

Body = TypeVar("Body")


def check_pose(body: BodyModel, pose: Tensor, transl: Tensor) -> None:
    """Refuse a pose [B,J,3] or a place [B,3] that does not fit the body.

    Raises:
        ValueError: says which, and what was expected.
    """
    if pose.ndim != 3 or pose.shape[1:] != (body.n_joints, 3):
        raise ValueError(
            f"expected pose [B,{body.n_joints},3] axis-angle for body {body.name!r}, got {tuple(pose.shape)}; "
            "poses of another body go through convert_pose"
        )
    if transl.shape != (len(pose), 3):
        raise ValueError(f"expected transl [{len(pose)},3] to match pose, got {tuple(transl.shape)}")


def check_shapes(pose: Tensor, rest_vertices: Tensor) -> None:
    """Refuse more shapes than one where there is not one a pose.

    Raises:
        ValueError: says how many there are.
    """
    if len(rest_vertices) not in (1, len(pose)):
        raise ValueError(f"expected one shape or {len(pose)} (one a pose), got {len(rest_vertices)}")


def pose_rest(
    rotations: Tensor,
    rest_vertices: Tensor,
    rest_joints: Tensor,
    lbs_weights: Tensor,
    parents: Sequence[int],
    transl: Tensor,
) -> BodyOutput:
    """Pose a shaped rest body by linear blend skinning.

    Args:
        rotations: [B,J,3,3] parent-relative, in the axes of rest space; the root's in the world.
        rest_vertices: [B,V,3] or [1,V,3].
        rest_joints: [B,J,3] or [1,J,3].
        lbs_weights: [V,J].
        parents: of the joints.
        transl: [B,3] metres.
    """
    batch = len(rotations)
    transforms = forward_kinematics(rotations, rest_joints, parents, transl)
    rest_vertices = rest_vertices.expand(batch, -1, -1)
    rest_joints = rest_joints.expand(batch, -1, -1)
    joints = (transforms[..., :3, :3] @ rest_joints[..., None])[..., 0] + transforms[..., :3, 3]
    return BodyOutput(lbs(rest_vertices, lbs_weights, transforms), joints, transforms, rest_vertices, rest_joints)


def moved_to(body: Body, device: torch.device | str | None, dtype: torch.dtype | None) -> Body:
    """A frozen dataclass of tensors, and of mappings of tensors, on another device or in another precision."""

    def move(value: Any) -> Any:
        if isinstance(value, Mapping):
            return {key: move(item) for key, item in value.items()}
        if not isinstance(value, Tensor):
            return value
        return value.to(device=device, dtype=dtype if value.is_floating_point() else None)

    return replace(body, **{field.name: move(getattr(body, field.name)) for field in fields(body)})  # type: ignore[type-var,arg-type]
