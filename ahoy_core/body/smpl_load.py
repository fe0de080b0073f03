"""The SMPL family's files as bodies.

The files are y up and face +z; everything is turned into our axes (z up, facing -y) when it is read, the pose blend
shapes' rotations included, so poses and results need no second convention.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np
import torch
from torch import Tensor

from ahoy_core.body.lbs import normalize_weights
from ahoy_core.body.smpl import HAND_JOINTS, SmplBody
from ahoy_core.body.smpl_names import JOINT_NAMES
from ahoy_core.body.smpl_parts import find_landmarks, find_regions
from ahoy_core.formats.errors import BodyFileError
from ahoy_core.formats.smpl import FlameFile, SmplFile, read_flame, read_obj_uv, read_smpl

# Our x, y, z are the file's x, -z, y.
_AXIS: Final = (0, 2, 1)
_SIGN: Final = (1.0, -1.0, 1.0)
# SMPL-X files hold 300 components of shape before the expressions; older ones 10 of each.
_SHAPE_SPACE: Final = {True: 300, False: 10}


def load_smpl(
    path: str | Path,
    *,
    uv: str | Path | None = None,
    head_ids: str | Path | None = None,
    flame: str | Path | None = None,
    n_betas: int = 10,
    n_expressions: int = 10,
    device: torch.device | str = "cpu",
    dtype: torch.dtype = torch.float32,
) -> SmplBody:
    """Load a body of the SMPL family from the user's `.npz`.

    Args:
        path: `SMPLX_NEUTRAL.npz`, `SMPL_FEMALE.npz`, SMPL+H's `model.npz`, ...
        uv: a `.obj` with texture coordinates; the file's own by default (SMPL-X's has them, SMPL's does not).
        head_ids: a `.npy` of vertex numbers that make the head, such as the makers' `SMPL-X__FLAME_vertex_ids.npy`; by
            default the vertices that head, jaw and eyes move most.
        flame: FLAME's `.npz`, whose expressions then stand for SMPL-X's own; needs `head_ids` of FLAME's vertices.
        n_betas: shape components to use, at most those of the file.
        n_expressions: expression components to use, likewise (0 for SMPL and SMPL+H).
        device: where the tensors go.
        dtype: torch.float32 or torch.float64.

    Raises:
        FileNotFoundError: no such file.
        BodyFileError: the file cannot be used; the text says why and what to do.
        ValueError: for another dtype.
    """
    if dtype not in (torch.float32, torch.float64):
        raise ValueError(f"expected dtype float32 or float64, got {dtype}; half precision loses millimetres")
    file = read_smpl(path)
    texture = _texture(file, uv)
    head = None if head_ids is None else np.load(head_ids, allow_pickle=False).astype(np.int64).ravel()
    if flame is not None:
        file = _with_flame(file, read_flame(flame), head, Path(flame).name)
    return _build(Path(path).stem.lower(), file, texture, head, n_betas, n_expressions).to(device, dtype)


def _with_flame(file: SmplFile, flame: FlameFile, head: np.ndarray | None, name: str) -> SmplFile:
    """SMPL-X with FLAME's expressions, which move the vertices that are FLAME's; its own shape components stay."""
    count = len(flame.expressions)
    if file.kind != "smplx" or head is None or len(head) != count:
        given = "no list of them" if head is None else f"a list of {len(head)}"
        raise BodyFileError(
            f"expected SMPL-X and the numbers of its {count} vertices that are FLAME's for {name!r}, got {file.kind} "
            f"and {given}; put SMPL-X__FLAME_vertex_ids.npy of the same makers beside the model"
        )
    shapes = file.arrays["shapedirs"]
    own = _SHAPE_SPACE[shapes.shape[2] > _SHAPE_SPACE[True]]
    joined = np.zeros((*shapes.shape[:2], _SHAPE_SPACE[True] + flame.expressions.shape[2]), shapes.dtype)
    joined[:, :, :own] = shapes[:, :, :own]
    joined[head, :, _SHAPE_SPACE[True] :] = flame.expressions
    return SmplFile(file.kind, {**file.arrays, "shapedirs": joined}, file.parents)


def _texture(file: SmplFile, uv: str | Path | None) -> tuple[np.ndarray, np.ndarray] | None:
    if uv is not None:
        return read_obj_uv(uv, file.arrays["f"])
    if "vt" in file.arrays and "ft" in file.arrays:
        return file.arrays["vt"].astype(np.float64), file.arrays["ft"].astype(np.int64)
    return None


def _build(
    name: str,
    file: SmplFile,
    texture: tuple[np.ndarray, np.ndarray] | None,
    head: np.ndarray | None,
    n_betas: int,
    n_expressions: int,
) -> SmplBody:
    """The body in float64; what is not kept (the unused components) is left in the file."""
    arrays = {key: torch.from_numpy(np.ascontiguousarray(value)) for key, value in file.arrays.items() if key != "f"}
    template = _turn(arrays["v_template"].double(), 1)
    basis, expressions = _shape_basis(file.kind, arrays["shapedirs"], n_betas, n_expressions)
    regressor = arrays["J_regressor"].double()
    regressor = regressor / regressor.sum(1, keepdim=True)
    weights = normalize_weights(arrays["weights"].double())
    faces = torch.from_numpy(file.arrays["f"].astype(np.int64))
    joint_names = JOINT_NAMES[file.kind]
    joints = regressor @ template
    regions = find_regions(joint_names, weights, template, joints, head)
    indices, landmark_weights = find_landmarks(file, joint_names, regressor, template, joints, regions)
    hands = all(key in arrays for key in ("hands_meanl", "hands_meanr", "hands_componentsl", "hands_componentsr"))
    return SmplBody(
        name=name if name.startswith("smpl") else f"{file.kind}_{name}",
        kind=file.kind,
        joint_names=joint_names,
        parents=file.parents,
        expression_names=tuple(f"expression_{number:02d}" for number in range(expressions)),
        default_betas=template.new_zeros(len(basis) - expressions),
        faces=faces,
        file_uvs=None if texture is None else torch.from_numpy(texture[0]),
        file_uv_faces=None if texture is None else torch.from_numpy(texture[1]),
        lbs_weights=weights,
        joint_regressor=regressor,
        regions=regions,
        landmark_indices=indices,
        landmark_weights=landmark_weights,
        hands_mean=_hands(arrays, "hands_mean", (HAND_JOINTS, 3)) if hands else None,
        hands_components=_hands(arrays, "hands_components", (3 * HAND_JOINTS, 3 * HAND_JOINTS)) if hands else None,
        template=template,
        shape_basis=basis,
        pose_basis=_pose_basis(arrays["posedirs"], len(joint_names)),
        template_joints=joints,
        joint_basis=regressor @ basis,
    )


def _turn(values: Tensor, axis: int) -> Tensor:
    """Turn one axis of vectors from the file's axes into ours."""
    sign = torch.tensor(_SIGN, dtype=values.dtype).reshape([-1 if i == axis else 1 for i in range(values.ndim)])
    return values.index_select(axis, torch.tensor(_AXIS)) * sign


def _shape_basis(kind: str, shapedirs: Tensor, n_betas: int, n_expressions: int) -> tuple[Tensor, int]:
    """Betas' and expressions' components [S+E,V,3], float64, and E."""
    total = shapedirs.shape[2]
    space = total if kind != "smplx" else _SHAPE_SPACE[total > _SHAPE_SPACE[True]]
    betas = min(n_betas, space, total)
    expressions = max(0, min(n_expressions, total - space))
    chosen = torch.cat([shapedirs[:, :, :betas], shapedirs[:, :, space : space + expressions]], dim=2)
    return _turn(chosen.double(), 1).permute(2, 0, 1).contiguous(), expressions


def _pose_basis(posedirs: Tensor, n_joints: int) -> Tensor:
    """Pose blend shapes [9(J-1),V,3] for rotations in our axes: R_file = C^T R C, so three axes turn, not one."""
    directions = posedirs.unflatten(2, (n_joints - 1, 3, 3))
    for axis in (1, 3, 4):
        directions = _turn(directions, axis)
    return directions.flatten(2).permute(2, 0, 1).contiguous()


def _hands(arrays: Mapping[str, Tensor], key: str, shape: tuple[int, int]) -> Tensor:
    """Left and right [2,*shape]; the last three numbers of each joint are a rotation vector, so they turn like one."""
    both = torch.stack([arrays[f"{key}l"], arrays[f"{key}r"]]).double()
    turned = _turn(both.reshape(2, -1, HAND_JOINTS, 3), 3)
    return turned.reshape(2, *shape)
