"""An avatar as files that other programs open, each with its label: which share is invented, and from which source.

Formats for viewers are y up or y down, as their readers expect; the avatar itself is z up (docs/conventions.md).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from ahoy_core.avatar.avatar import Avatar, Posed
from ahoy_core.body.canonical import canonical_pose
from ahoy_core.body.convert import body_skeleton
from ahoy_core.body.model import BodyModel
from ahoy_core.formats.atomic import atomic_path
from ahoy_core.formats.glb import write_glb
from ahoy_core.formats.npz import save_npz
from ahoy_core.formats.ply import write_ply
from ahoy_core.formats.spz import write_spz
from ahoy_core.motion.motion import Motion
from ahoy_core.splat.gaussians import Gaussians
from ahoy_core.splat.transform import Similarity, transform_gaussians

Axes = Literal["z-up", "y-up", "y-down"]
SplatFormat = Literal["ply", "spz", "glb"]
AXES: Mapping[str, Axes] = {"ply": "y-down", "spz": "y-up", "glb": "y-up"}
"""What each format's readers expect: 3DGS files are right, down, forward; SPZ and glTF right, up, back."""
_TURNS: Mapping[Axes, Tensor] = {
    "z-up": torch.eye(3, dtype=torch.float64),
    "y-up": torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]], dtype=torch.float64),
    "y-down": torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64),
}
OBSERVED = 0.5
"""A Gaussian counts as observed if the video showed at least this much of its surface."""


def turned(gaussians: Gaussians, axes: Axes) -> Gaussians:
    """Gaussians of our world (z up, facing -y) in the axes of a file."""
    return transform_gaussians(gaussians, Similarity(_TURNS[axes], torch.zeros(3, dtype=torch.float64)))[0]


def facts(avatar: Avatar) -> dict[str, Any]:
    """What every export says about itself."""
    info = avatar.info
    return {
        "synthetic_media": info.synthetic_media,
        "invented_share": round(1 - avatar.observed_share, 4),
        "observed_share": round(avatar.observed_share, 4),
        "source": info.provenance.get("source", "unknown"),
        "licence": info.licence or "unknown",
        "body": info.body,
    }


def export_splats(
    avatar: Avatar, path: Path, kind: SplatFormat, posed: Posed | None = None, axes: Axes | None = None
) -> None:
    """Write the avatar as Gaussians, canonical or posed.

    `.ply` and `.glb` carry an attribute `observed` (1 or 0) and `coverage` in [0,1] for each Gaussian and the facts in
    their header; `.spz` has no place for either, so both go to `NAME.json` beside it.

    Args:
        avatar: What to write.
        path: Target.
        kind: ply, spz or glb.
        posed: From `Avatar.pose`; the canonical pose by default.
        axes: Of the file; what the format's readers expect by default.

    Raises:
        ValueError: Values that the format cannot hold.
    """
    gaussians = turned(avatar.to_gaussians(posed), axes or AXES[kind])
    flags = {"observed": (avatar.observed >= OBSERVED).float(), "coverage": avatar.observed.float()}
    says = facts(avatar)
    if kind == "ply":
        comments = [f"{name}: {value}".encode("ascii", "replace").decode() for name, value in says.items()]
        write_ply(path, gaussians, flags, [*comments, f"axes: {axes or AXES[kind]}"])
    elif kind == "glb":
        write_glb(path, gaussians, extra=flags, extras=says)
    else:
        write_spz(path, gaussians)
        _write_facts(path.with_suffix(path.suffix + ".json"), says, flags["observed"])


def _write_facts(path: Path, says: Mapping[str, Any], observed: Tensor) -> None:
    flags = "".join("1" if flag else "0" for flag in observed.bool().tolist())
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps({**says, "observed": flags}, ensure_ascii=False), encoding="utf-8")


def export_rig(avatar: Avatar, body: BodyModel, path: Path) -> None:
    """Write the avatar as arrays for other skinning code: Gaussians, weights, skeleton, UV and flags, z up, metres.

    A pose moves a Gaussian by sum_k w_k T_k, T_j = G_j(pose) inverse_bind_j, with G_j the joint's place in the world.
    """
    skeleton = body_skeleton(body, avatar.betas)
    arrays: dict[str, Tensor | np.ndarray] = {
        "means": avatar.means,
        "quats_wxyz": avatar.quats,
        "scales": avatar.scales,
        "opacities": avatar.opacities,
        "colors": avatar.colors,
        "skin_indices": avatar.skin_indices,
        "skin_weights": avatar.skin_weights,
        "joint_names": np.array(skeleton.joint_names),
        "parents": np.array(skeleton.parents),
        "rest_joints": skeleton.rest_joints.float(),
        "canonical_pose": canonical_pose(body),
        "betas": avatar.betas,
        "training_poses": avatar.training_poses,
        "uv": avatar.uv,
        "map_pixels": avatar.template.pixels,
        "map_size": np.array(avatar.template.map_size),
        "coverage": avatar.observed,
        "observed": avatar.observed >= OBSERVED,
        "head": avatar.head,
    }
    arrays |= {name: np.array(str(value)) for name, value in facts(avatar).items()}
    save_npz(path, {n: v.detach().numpy() if isinstance(v, Tensor) else v for n, v in arrays.items()})


def export_frames(
    avatar: Avatar, body: BodyModel, motion: Motion, folder: Path, kind: SplatFormat = "ply", axes: Axes | None = None
) -> list[Path]:
    """Write one file a frame of a motion, `00000.ply` and so on; files that are there already are written again."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for frame in range(len(motion)):
        paths.append(folder / f"{frame:05d}.{kind}")
        export_splats(avatar, paths[-1], kind, avatar.pose(body, motion.pose[frame], motion.transl[frame]), axes)
    return paths
