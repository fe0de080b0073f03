"""A tiny person of eight ellipsoids with a UV chart each, and its pictures: fast, and true by construction."""

from __future__ import annotations

import math
from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import torch
from torch import Tensor

from ahoy_core.conventions import OBSERVED_VIEWMAT
from ahoy_core.texture.rays import Caster, hit_map, to_camera
from ahoy_core.texture.surface import Surface

LATITUDES, LONGITUDES = 10, 20
# centre, half axes, joint; left is +x
PARTS: dict[str, tuple[tuple[float, float, float], tuple[float, float, float], int]] = {
    "torso": ((0, 0, 1.15), (0.18, 0.11, 0.33), 0),
    "head": ((0, 0, 1.62), (0.09, 0.1, 0.13), 1),
    "arm.L": ((0.33, 0, 1.15), (0.055, 0.055, 0.25), 2),
    "arm.R": ((-0.33, 0, 1.15), (0.055, 0.055, 0.25), 3),
    "hand.L": ((0.33, 0, 0.8), (0.045, 0.03, 0.09), 2),
    "hand.R": ((-0.33, 0, 0.8), (0.045, 0.03, 0.09), 3),
    "leg.L": ((0.11, 0, 0.42), (0.08, 0.09, 0.42), 4),
    "leg.R": ((-0.11, 0, 0.42), (0.08, 0.09, 0.42), 5),
}
JOINTS = ((0.0, 0, 0.9), (0, 0, 1.5), (0.25, 0, 1.38), (-0.25, 0, 1.38), (0.11, 0, 0.82), (-0.11, 0, 0.82))
K = np.array([[250.0, 0, 64], [0, 250.0, 64], [0, 0, 1]], dtype=np.float32)


def _ellipsoid(centre, axes, cell):
    lat = np.linspace(0, math.pi, LATITUDES + 1)
    lon = np.linspace(0, 2 * math.pi, LONGITUDES, endpoint=False)
    ring = np.stack(
        [
            np.outer(np.sin(lat), np.cos(lon)),
            np.outer(np.sin(lat), np.sin(lon)),
            np.outer(np.cos(lat), np.ones(LONGITUDES)),
        ],
        axis=-1,
    )
    vertices = (ring * np.array(axes) + np.array(centre)).reshape(-1, 3)
    u, v = np.meshgrid(np.linspace(0.03, 0.97, LONGITUDES + 1), np.linspace(0.97, 0.03, LATITUDES + 1))
    uvs = np.stack([(u + cell % 4) / 4, (v + cell // 4) / 2], axis=-1).reshape(-1, 2)
    faces, uv_faces = [], []
    for i in range(LATITUDES):
        for j in range(LONGITUDES):
            k = (j + 1) % LONGITUDES
            corner = [i * LONGITUDES + j, (i + 1) * LONGITUDES + j, (i + 1) * LONGITUDES + k, i * LONGITUDES + k]
            row = LONGITUDES + 1
            uv_corner = [i * row + j, (i + 1) * row + j, (i + 1) * row + j + 1, i * row + j + 1]
            # At the poles one of a cell's two triangles has no area.
            for a, b, c in ((0, 1, 2), (0, 2, 3))[int(i == LATITUDES - 1) : 1 + int(i > 0)]:
                faces.append([corner[a], corner[b], corner[c]])
                uv_faces.append([uv_corner[a], uv_corner[b], uv_corner[c]])
    return vertices, uvs, np.array(faces), np.array(uv_faces)


class CapsuleBody:
    """Fulfils the body protocol: rigid parts, one shape parameter (relative height), one expression without effect."""

    name = "capsules"
    joint_names = ("root", "head", "arm.L", "arm.R", "leg.L", "leg.R")
    parents = (-1, 0, 0, 0, 0, 0)
    n_joints, n_betas, n_expressions = 6, 1, 1
    expression_names = ("none",)

    def __init__(self) -> None:
        vertices, uvs, faces, uv_faces, joint_of, part_of = [], [], [], [], [], []
        for cell, (name, (centre, axes, joint)) in enumerate(PARTS.items()):
            v, t, f, g = _ellipsoid(centre, axes, cell)
            faces.append(f + sum(map(len, vertices)))
            uv_faces.append(g + sum(map(len, uvs)))
            vertices.append(v)
            uvs.append(t)
            joint_of += [joint] * len(v)
            part_of += [name] * len(v)
        self.rest = torch.tensor(np.concatenate(vertices), dtype=torch.float32)
        self.rest_joints = torch.tensor(JOINTS, dtype=torch.float32)
        self.faces = torch.tensor(np.concatenate(faces))
        self.uvs = torch.tensor(np.concatenate(uvs), dtype=torch.float32)
        self.uv_faces = torch.tensor(np.concatenate(uv_faces))
        self.joint_of = torch.tensor(joint_of)
        self.lbs_weights = torch.nn.functional.one_hot(self.joint_of, 6).float()
        self.default_betas = torch.zeros(1)
        self.parts = np.array(part_of)
        self.regions = {
            "head": torch.tensor(self.parts == "head"),
            "hands": torch.tensor(np.char.startswith(self.parts, "hand")),
            "feet": torch.zeros(len(self.parts), dtype=torch.bool),
            "interior": torch.zeros(len(self.parts), dtype=torch.bool),
        }

    def __call__(
        self, pose: Tensor, betas: Tensor, transl: Tensor, expression: Tensor | None = None
    ) -> SimpleNamespace:
        scale = (1 + betas[:, :1])[:, None]
        rotation = torch.linalg.matrix_exp(_skew(pose))
        rest, joints = self.rest * scale, self.rest_joints * scale
        world = torch.cat([rotation[:, :1], rotation[:, :1] @ rotation[:, 1:]], dim=1)
        pivot = joints[:, :1] + torch.einsum("bij,bkj->bki", rotation[:, 0], joints - joints[:, :1])
        of = self.joint_of
        vertices = pivot[:, of] + torch.einsum("bvij,bvj->bvi", world[:, of], rest - joints[:, of])
        return SimpleNamespace(vertices=vertices + transl[:, None], joints=pivot + transl[:, None])


def _skew(vector: Tensor) -> Tensor:
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).reshape(*vector.shape, 3)


def smooth_paint(points: np.ndarray) -> np.ndarray:
    """Colours [N,3] in 0..255, smooth in rest positions [N,3]: front and back, left and right differ."""
    x, y, z = points.T
    return np.stack([128 + 200 * x, 128 + 600 * y, 60 + 80 * z], axis=1).clip(0, 255)


def standing(count: int, distance: float = 4.0, turn: float = 0.0) -> dict[str, np.ndarray]:
    """Perception arrays of a person standing still before the observed camera, turned about z by `turn` radians."""
    pose = np.zeros((count, 6, 3), dtype=np.float32)
    pose[:, 0, 2] = turn
    return {
        "pose": pose,
        "transl": np.tile(np.float32([0, distance, -0.9]), (count, 1)),
        "betas": np.zeros(1, dtype=np.float32),
        "expression": np.zeros((count, 1), dtype=np.float32),
        "joint_confidence": np.ones((count, 6), dtype=np.float32),
        "frame_confidence": np.ones(count, dtype=np.float32),
        "used": np.ones(count, dtype=bool),
        "viewmat": OBSERVED_VIEWMAT.numpy(),
        "K": K,
    }


def pictures(
    body: CapsuleBody,
    fit: dict[str, np.ndarray],
    paint: Callable[[np.ndarray], np.ndarray],
    size: int = 128,
    background: tuple[int, int, int] = (0, 255, 0),
) -> tuple[np.ndarray, np.ndarray]:
    """Frames [T,H,W,3] uint8 of the body, coloured by rest position (no atlas), and true masks [T,H,W] uint8."""
    surface = Surface.of(body)
    rest = body.rest.numpy() * (1 + float(fit["betas"][0]))
    frames = np.empty((len(fit["pose"]), size, size, 3), dtype=np.uint8)
    frames[:] = background
    masks = np.zeros(frames.shape[:3], dtype=np.uint8)
    for t in range(len(frames)):
        posed = body(*(torch.as_tensor(a)[None] for a in (fit["pose"][t], fit["betas"], fit["transl"][t]))).vertices[0]
        hits = hit_map(Caster(to_camera(posed.numpy(), fit["viewmat"]), surface.faces), fit["K"], size, size)
        seen = hits.face >= 0
        points = (rest[surface.faces[hits.face[seen]]] * hits.bary[seen][:, :, None]).sum(axis=1)
        frames[t][seen] = np.rint(paint(points))
        masks[t][seen] = 255
    return frames, masks
