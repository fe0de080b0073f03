"""What every body is to the rest of the system: the protocol and its output."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from torch import Tensor


@dataclass(frozen=True)
class BodyOutput:
    """A posed body.

    Attributes:
        vertices: [B,V,3] posed, world, metres.
        joints: [B,J,3] posed, world, metres.
        transforms: [B,J,4,4] rest space -> world, what skinning blends.
        rest_vertices: [B,V,3] shaped (betas, expression, and pose blend shapes where the body has them), rest pose:
            skinning them by `transforms` gives `vertices`.
        rest_joints: [B,J,3] shaped, rest pose.
    """

    vertices: Tensor
    joints: Tensor
    transforms: Tensor
    rest_vertices: Tensor
    rest_joints: Tensor


@runtime_checkable
class BodyModel(Protocol):
    """A skinned body with shape and expression; everything is differentiable in pose, betas, transl and expression.

    Rotations are expressed in the axes of rest space (z up, facing -y), parent-relative; the root's is its rotation in
    the world, about its rest position, and `transl` is added last: zero pose and zero `transl` give the rest body.
    """

    @property
    def name(self) -> str:
        """Identifies the body in files and reports."""
        ...

    @property
    def joint_names(self) -> tuple[str, ...]:
        """J names."""
        ...

    @property
    def parents(self) -> tuple[int, ...]:
        """Parent of each joint, -1 for the root at index 0; parents come before children."""
        ...

    @property
    def n_joints(self) -> int:
        """J."""
        ...

    @property
    def n_betas(self) -> int:
        """S."""
        ...

    @property
    def n_expressions(self) -> int:
        """E."""
        ...

    @property
    def expression_names(self) -> tuple[str, ...]:
        """E names."""
        ...

    @property
    def default_betas(self) -> Tensor:
        """[S] an average adult."""
        ...

    @property
    def faces(self) -> Tensor:
        """[F,3] int64 triangles, counter-clockwise from outside."""
        ...

    @property
    def uvs(self) -> Tensor:
        """[Vt,2] in [0,1], origin at the lower left (OBJ convention)."""
        ...

    @property
    def uv_faces(self) -> Tensor:
        """[F,3] int64 into uvs."""
        ...

    @property
    def lbs_weights(self) -> Tensor:
        """[V,J] dense, rows sum to 1."""
        ...

    @property
    def regions(self) -> Mapping[str, Tensor]:
        """Bool [V] each: "head", "hands", "feet", "interior" (mouth, tongue, eye sockets: never textured)."""
        ...

    @property
    def landmark_indices(self) -> Tensor:
        """[33,K] int64 vertices that the BlazePose landmarks are blends of (see `keypoints`)."""
        ...

    @property
    def landmark_weights(self) -> Tensor:
        """[33,K] >= 0, rows sum to 1, padded with zeros."""
        ...

    def __call__(self, pose: Tensor, betas: Tensor, transl: Tensor, expression: Tensor | None = None) -> BodyOutput:
        """Poses the body.

        Args:
            pose: [B,J,3] axis-angle, radians.
            betas: [B,S], or [1,S] for one shape in all poses.
            transl: [B,3] metres.
            expression: [B,E] or [1,E]; neutral by default.
        """
        ...
