"""SMPL, SMPL+H and SMPL-X from the user's licensed files, as `BodyModel`s (Loper et al. 2015, Pavlakos et al. 2019).

`ahoy_core.body.smpl_load` reads them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final, Literal

import torch
from torch import Tensor

from ahoy_core.body.model import BodyOutput
from ahoy_core.body.posing import check_pose, check_shapes, moved_to, pose_rest
from ahoy_core.body.rotations import axis_angle_to_matrix

HAND_JOINTS: Final = 15


@dataclass(frozen=True, eq=False)
class SmplBody:
    """A `BodyModel` of the SMPL family.

    Pose 0 is the file's template: a T-pose with flat hands (no mean hand pose is added; `hand_pose` adds it where it is
    asked for). Betas and expressions are the file's principal components, 0 the average, in standard deviations.

    Beyond the protocol:

    Attributes:
        kind: "smpl", "smplh" or "smplx".
        joint_regressor: [J,V] joints of the shaped rest body; rows sum to 1.
        hands_mean: [2,15,3] axis-angle, left and right; None for SMPL.
        hands_components: [2,45,45] rows are principal components of a hand's pose; None for SMPL.
    """

    name: str
    kind: str
    joint_names: tuple[str, ...]
    parents: tuple[int, ...]
    expression_names: tuple[str, ...]
    default_betas: Tensor
    faces: Tensor
    file_uvs: Tensor | None
    file_uv_faces: Tensor | None
    lbs_weights: Tensor
    joint_regressor: Tensor
    regions: Mapping[str, Tensor]
    landmark_indices: Tensor
    landmark_weights: Tensor
    hands_mean: Tensor | None
    hands_components: Tensor | None
    template: Tensor  # [V,3]
    shape_basis: Tensor  # [S+E,V,3] betas, then expressions
    pose_basis: Tensor  # [9(J-1),V,3]
    template_joints: Tensor  # [J,3]
    joint_basis: Tensor  # [S+E,J,3]

    @property
    def n_joints(self) -> int:
        """J."""
        return len(self.joint_names)

    @property
    def n_vertices(self) -> int:
        """V."""
        return len(self.template)

    @property
    def n_betas(self) -> int:
        """S."""
        return len(self.default_betas)

    @property
    def n_expressions(self) -> int:
        """E."""
        return len(self.expression_names)

    @property
    def uvs(self) -> Tensor:
        """[Vt,2] in [0,1].

        Raises:
            ValueError: when neither the body's file nor the user gave texture coordinates.
        """
        return self._texture_coordinates()[0]

    @property
    def uv_faces(self) -> Tensor:
        """[F,3] int64 into uvs; raises as `uvs` does."""
        return self._texture_coordinates()[1]

    def _texture_coordinates(self) -> tuple[Tensor, Tensor]:
        if self.file_uvs is None or self.file_uv_faces is None:
            raise ValueError(
                f"expected texture coordinates of {self.name}, got none: its file holds none; give the makers' UV "
                "template, load_smpl(path, uv=OBJ), or put it beside the model as docs/models.md says"
            )
        return self.file_uvs, self.file_uv_faces

    def shape(self, betas: Tensor, expression: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """The body at rest without pose blend shapes: vertices [B,V,3] and joints [B,J,3], metres.

        Args:
            betas: [B,S] or [1,S].
            expression: [B,E] or [1,E], FLAME's expression space; neutral by default.

        Raises:
            ValueError: when a size does not fit this body.
        """
        expression = betas.new_zeros(1, self.n_expressions) if expression is None else expression
        for name, values, size in (("betas", betas, self.n_betas), ("expression", expression, self.n_expressions)):
            if values.ndim != 2 or values.shape[1] != size:
                raise ValueError(
                    f"expected {name} [B,{size}], got {tuple(values.shape)}; add a batch dimension or load"
                )
        if 1 != len(expression) != len(betas) != 1:
            raise ValueError(f"expected as many expressions as betas, or one, got {len(expression)} and {len(betas)}")
        batch = max(len(betas), len(expression))
        both = torch.cat([betas.expand(batch, -1), expression.expand(batch, -1)], dim=1)
        vertices = self.template + (both @ self.shape_basis.flatten(1)).unflatten(1, (-1, 3))
        return vertices, self.template_joints + (both @ self.joint_basis.flatten(1)).unflatten(1, (-1, 3))

    def __call__(self, pose: Tensor, betas: Tensor, transl: Tensor, expression: Tensor | None = None) -> BodyOutput:
        """Poses the body; see `BodyModel`.

        Raises:
            ValueError: when a size does not fit this body.
        """
        check_pose(self, pose, transl)
        vertices, rest_joints = self.shape(betas, expression)
        check_shapes(pose, vertices)
        rotations = axis_angle_to_matrix(pose)
        departure = rotations[:, 1:] - torch.eye(3, dtype=pose.dtype, device=pose.device)
        vertices = vertices + (departure.flatten(1) @ self.pose_basis.flatten(1)).unflatten(1, (-1, 3))
        return pose_rest(rotations, vertices, rest_joints, self.lbs_weights, self.parents, transl)

    def hand_pose(self, components: Tensor, side: Literal["left", "right"]) -> Tensor:
        """A hand's pose [B,15,3] axis-angle from PCA coefficients, the mean hand included.

        Args:
            components: [B,C] coefficients of the first C <= 45 components; all 0 is the mean, relaxed hand.
            side: whose.

        Raises:
            ValueError: for SMPL, which has no fingers, or more coefficients than components.
        """
        if self.hands_mean is None or self.hands_components is None:
            raise ValueError(f"expected SMPL+H or SMPL-X for a hand's pose, got {self.name!r}, whose file holds no PCA")
        row, size = ("left", "right").index(side), components.shape[-1]
        if size > self.hands_components.shape[1]:
            raise ValueError(f"expected at most {self.hands_components.shape[1]} coefficients, got {size}")
        offset = components @ self.hands_components[row, :size]
        return self.hands_mean[row] + offset.unflatten(-1, (HAND_JOINTS, 3))

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> SmplBody:
        """The same body on another device or in another precision."""
        return moved_to(self, device, dtype)

    def subset(self, indices: Tensor) -> SmplBody:
        """The same body with some of its vertices only: cheap to pose, for fits.

        Triangles whose corners are not all kept are gone, and so are landmarks (asking for them is an error) unless
        all of their vertices are kept.

        Args:
            indices: [n] int64, distinct, in the order wanted.
        """
        position = torch.full((self.n_vertices,), -1, dtype=torch.int64, device=indices.device)
        position[indices] = torch.arange(len(indices), device=indices.device)
        kept = (position[self.faces] >= 0).all(1)
        return replace(
            self,
            faces=position[self.faces[kept]],
            file_uv_faces=None if self.file_uv_faces is None else self.file_uv_faces[kept],
            lbs_weights=self.lbs_weights[indices],
            joint_regressor=self.joint_regressor[:, indices],
            regions={key: mask[indices] for key, mask in self.regions.items()},
            landmark_indices=position[self.landmark_indices],
            template=self.template[indices],
            shape_basis=self.shape_basis[:, indices],
            pose_basis=self.pose_basis[:, indices],
        )
