"""Puts a person together: body, clothes, shoes, hair and brows as one skinned mesh with materials."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from ahoy_core.body.packaged import PackagedBody
from ahoy_core.prior.corpus.basemesh import BaseMesh
from ahoy_core.prior.corpus.makehuman import Garment
from ahoy_core.prior.corpus.outfits import Outfit, Shell
from ahoy_core.prior.corpus.shells import BodyChart, hair_cap, lower_layer, upper_layer
from ahoy_core.prior.corpus.wardrobe import TEXTURE_SIZE, Wardrobe, texture

Array = NDArray[Any]
Kind = Literal["skin", "eyes", "upper", "lower", "shoes", "hair", "brows"]
KINDS: tuple[Kind, ...] = ("skin", "eyes", "upper", "lower", "shoes", "hair", "brows")

# What the skin's colouring needs to know of the face: eyes and mouth, as landmarks of the packaged body.
_FEATURES = ("left_eye", "right_eye", "mouth_left", "mouth_right")


@dataclass(frozen=True, eq=False)
class Dressed:
    """A person at rest.

    Attributes:
        outfit: who and what.
        vertices: [V,3] metres, rest space of the packaged body.
        lbs_weights: [V,J] float32.
        faces: [F,3] int32.
        uvs: [F,3,2] float32.
        materials: [F] int32 index into `KINDS`.
        textures: [len(KINDS),S,S,4] uint8.
        textured: [len(KINDS)] bool: the texture has colours of its own.
        greyness: [len(KINDS)] float32 mean grey of each texture in [0,1].
        features: [4,3] metres: left and right eye, left and right corner of the mouth.
        joints: [J,3] metres at rest.
    """

    outfit: Outfit
    vertices: Array
    lbs_weights: Array
    faces: Array
    uvs: Array
    materials: Array
    textures: Array
    textured: Array
    greyness: Array
    features: Array
    joints: Tensor


@dataclass(frozen=True, eq=False)
class _Piece:
    vertices: Array
    lbs_weights: Array
    faces: Array
    uvs: Array
    materials: Array


class Dresser:
    """Dresses bodies.

    Args:
        body: the packaged body.
        wardrobe: the garments.
    """

    def __init__(self, body: PackagedBody, wardrobe: Wardrobe) -> None:
        self.body, self.wardrobe = body, wardrobe
        self.mesh = BaseMesh(body)
        self.chart = BodyChart(body)

    def dress(self, outfit: Outfit) -> Dressed:
        """Fits everything an outfit names to its body."""
        rest, joints = self.body.shape(outfit.betas[None])
        vertices = rest[0].numpy()
        normals = vertex_normals(vertices, self.body.faces.numpy())
        textures = np.full((len(KINDS), TEXTURE_SIZE, TEXTURE_SIZE, 4), 255, dtype=np.uint8)
        textured = np.zeros(len(KINDS), dtype=bool)
        hidden = np.zeros(int(self.body.source_index.max()) + 1, dtype=bool)
        pieces = []
        for kind, garment in self._garments(outfit):
            hidden[garment.covered[garment.covered < len(hidden)]] = True
            pieces.append(self._fitted(kind, garment, outfit))
            has_texture = garment.diffuse is not None and (kind != "upper" or outfit.textured)
            image = texture(garment.diffuse if has_texture else None, garment.occlusion, kind not in ("hair", "brows"))
            for k in (KINDS.index(kind), KINDS.index("lower")) if kind == "upper" else (KINDS.index(kind),):
                textures[k], textured[k] = image, has_texture
        if outfit.cloth is not None:
            pieces += _shell_pieces(self.chart, outfit.cloth, vertices, normals)
        if outfit.hair == "cap":
            cap = hair_cap(self.chart, vertices, normals, 0.004 + 0.02 * float(outfit.betas[5]))
            pieces.append(_plain(cap.vertices, cap.lbs_weights, cap.faces, "hair"))
        pieces.insert(0, self._skin(vertices, hidden))
        features = torch.stack([self._landmark(name, rest[0]) for name in _FEATURES]).numpy()
        return _assembled(outfit, pieces, textures, textured, features, joints[0])

    def _garments(self, outfit: Outfit) -> list[tuple[Kind, Garment]]:
        chosen: list[tuple[Kind, str, str | None]] = [
            ("upper", "clothes", outfit.suit),
            ("shoes", "clothes", outfit.shoes),
            ("hair", "hair", None if outfit.hair == "cap" else outfit.hair),
            ("brows", "eyebrows", outfit.brows),
        ]
        return [(kind, self.wardrobe.garment(folder, name)) for kind, folder, name in chosen if name is not None]

    def _fitted(self, kind: Kind, garment: Garment, outfit: Outfit) -> _Piece:
        vertices, weights = self.mesh.fit(garment, self.mesh.vertices(outfit.betas))
        materials = np.full(len(garment.faces), KINDS.index(kind), dtype=np.int32)
        if kind == "upper":
            hip = float(self.chart.rest[1][list(self.body.joint_names).index("upperleg01.L"), 2])
            materials[_is_lower(garment.faces, vertices, hip)] = KINDS.index("lower")
        return _Piece(vertices, weights, garment.faces, garment.uvs, materials)

    def _skin(self, vertices: Array, hidden: Array) -> _Piece:
        """The body's skin and eyes, without the mouth's inside and what garments cover."""
        covered = hidden[self.body.source_index.numpy()][self.body.faces.numpy()].all(1)
        kept = ~covered & ~self.body.face_regions["interior"].numpy()
        eyes = self.body.face_regions["eyes"].numpy()[kept]
        faces = self.body.faces.numpy()[kept].astype(np.int32)
        uvs = self.body.uvs[self.body.uv_faces].numpy()[kept]
        materials = np.where(eyes, KINDS.index("eyes"), KINDS.index("skin")).astype(np.int32)
        return _Piece(vertices, self.body.lbs_weights.numpy(), faces, uvs, materials)

    def _landmark(self, name: str, vertices: Tensor) -> Tensor:
        k = self.body.landmark_names.index(name)
        return (vertices[self.body.landmark_indices[k]] * self.body.landmark_weights[k, :, None]).sum(0)


def vertex_normals(vertices: Array, faces: Array) -> Array:
    """Outward unit normals [V,3], area-weighted; a vertex without area gets zero."""
    corners = vertices[faces]
    face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.stack([np.bincount(faces.ravel(), np.repeat(face[:, k], 3), len(vertices)) for k in range(3)], 1)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


def _plain(vertices: Array, weights: Array, faces: Array, kind: Kind) -> _Piece:
    uvs = np.zeros((len(faces), 3, 2), dtype=np.float32)
    return _Piece(vertices, weights, faces, uvs, np.full(len(faces), KINDS.index(kind), dtype=np.int32))


def _shell_pieces(chart: BodyChart, shell: Shell, vertices: Array, normals: Array) -> list[_Piece]:
    lower = lower_layer(chart, shell, vertices, normals)
    upper = upper_layer(chart, shell, vertices, normals)
    return [
        _plain(lower.vertices, lower.lbs_weights, lower.faces, "lower"),
        _plain(upper.vertices, upper.lbs_weights, upper.faces, "upper"),
    ]


def _is_lower(faces: Array, vertices: Array, hip: float) -> Array:
    """[F] bool: which of a suit's connected pieces are trousers; a suit of one piece is cut at the hip."""
    n = len(vertices)
    links = coo_matrix(
        (np.ones(2 * len(faces)), (np.r_[faces[:, 0], faces[:, 1]], np.r_[faces[:, 1], faces[:, 2]])), (n, n)
    )
    count, label = connected_components(links, directed=False)
    middle = np.array([np.median(vertices[label == c, 2]) for c in range(count)])
    below = (middle < hip + 0.02)[label]
    if below.all() or not below.any():
        below = vertices[:, 2] < hip + 0.08
    return below[faces[:, 0]]


def _grey(image: Array) -> float:
    """Mean grey of a texture's opaque texels, a sixteenth of them."""
    sparse = image[::4, ::4]
    solid = sparse[sparse[..., 3] > 127]
    return max(0.05, float(solid[:, :3].mean()) / 255) if len(solid) else 1.0


def _assembled(
    outfit: Outfit, pieces: list[_Piece], textures: Array, textured: Array, features: Array, joints: Tensor
) -> Dressed:
    starts = np.cumsum([0] + [len(piece.vertices) for piece in pieces[:-1]])
    return Dressed(
        outfit=outfit,
        vertices=np.concatenate([piece.vertices for piece in pieces]).astype(np.float32),
        lbs_weights=np.concatenate([piece.lbs_weights for piece in pieces]).astype(np.float32),
        faces=np.concatenate([piece.faces + start for piece, start in zip(pieces, starts, strict=True)]).astype(
            np.int32
        ),
        uvs=np.concatenate([piece.uvs for piece in pieces]).astype(np.float32),
        materials=np.concatenate([piece.materials for piece in pieces]),
        textures=textures,
        textured=textured,
        greyness=np.array([_grey(image) for image in textures], dtype=np.float32),
        features=features.astype(np.float32),
        joints=joints,
    )
