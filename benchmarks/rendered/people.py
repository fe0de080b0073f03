"""Clothed people: a shape, an outfit, shoes, hair and brows, all skinned by the packaged body's joints."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from ahoy_core.body.compile import nearest_kept
from ahoy_core.body.keypoints import LANDMARK_NAMES
from ahoy_core.body.lbs import lbs
from ahoy_core.body.packaged import PackagedBody
from benchmarks.rendered.garments import Garment, read_garment

FloatArray = NDArray[np.float64]
# Left out here: the outfits of the shared captures, so that those stay a check.
MEN = (
    "male_casualsuit01",
    "male_casualsuit02",
    "male_casualsuit04",
    "male_casualsuit05",
    "male_casualsuit06",
    "male_elegantsuit01",
)
WOMEN = ("female_casualsuit02", *MEN[:3])
MENS_HAIR = ("short01", "short02", "short03", "short04")
WOMENS_HAIR = ("bob02", "braid01", "long01", "ponytail01", "short03")
TEXTURE_SIZE = 512
BASE_VERTICES = 19158  # of MakeHuman's mesh, helpers included
SKIN_TONES = ((225, 172, 148), (240, 198, 176), (198, 140, 110), (150, 98, 70), (105, 68, 50), (214, 160, 126))
HAIR_TONES = ((40, 28, 22), (75, 48, 30), (120, 84, 52), (25, 22, 22), (170, 130, 80), (130, 125, 120))


@dataclass(frozen=True)
class Part:
    """A mesh with one texture.

    Attributes:
        rest: [N,3] metres, rest pose; None for the skin, whose vertices come from the body itself.
        weights: [N,J].
        faces: [F,3].
        uvs: [F,3,2].
        texture: [S,S,4] uint8 RGBA.
        tint: [N,3] that multiplies the texture.
        cut: whether the texture's alpha is to be looked at.
        garment: what it was made from.
    """

    rest: FloatArray | None
    weights: FloatArray | None
    faces: NDArray[np.int64]
    uvs: FloatArray
    texture: NDArray[np.uint8]
    tint: FloatArray
    cut: bool
    garment: Garment | None = None


@dataclass(frozen=True)
class Person:
    """A subject: `betas` [S] and parts, the skin first."""

    betas: torch.Tensor
    parts: tuple[Part, ...]
    outfit: str
    hair: str

    def posed(
        self, body: PackagedBody, pose: torch.Tensor, transl: torch.Tensor, expression: torch.Tensor | None = None
    ) -> list[FloatArray]:
        """Vertices [N,3] of every part for one pose [J,3], metres, world."""
        shown = None if expression is None else expression[None]
        with torch.no_grad():
            out = body(pose[None], self.betas[None], transl[None], shown)
            moved = [out.vertices[0].double().numpy()]
            pulled = None
            if expression is not None:
                neutral, _ = body.shape(self.betas[None])
                pulled = np.zeros((BASE_VERTICES, 3))
                pulled[body.source_index.numpy()] = (out.rest_vertices - neutral)[0].numpy()
            for part in self.parts[1:]:
                assert part.rest is not None and part.weights is not None and part.garment is not None
                rest, weights = torch.from_numpy(part.rest).float(), torch.from_numpy(part.weights).float()
                if pulled is not None:
                    # Brows go where the forehead goes.
                    rest = rest + torch.from_numpy(part.garment.follow(pulled)).float()
                moved.append(lbs(rest[None], weights, out.transforms)[0].double().numpy())
        return moved


class Wardrobe:
    """Anny's full base mesh, on which garments hang, and the folder of garments."""

    def __init__(self, assets: Path, body: PackagedBody) -> None:
        import anny

        self.assets, self.body = assets, body
        self.model = anny.create_fullbody_model(
            rig="default", topology="default", remove_unattached_vertices=False, pose_parameterization="local-ref"
        )
        kept = [self.model.bone_labels.index(name) for name in body.joint_names]
        carrier = np.array(nearest_kept(body.rig_parents, kept))
        bones, shares = self.model.vertex_bone_indices.numpy(), self.model.vertex_bone_weights.double().numpy()
        self.weights = np.zeros((len(bones), body.n_joints))
        np.add.at(self.weights, (np.arange(len(bones))[:, None], carrier[bones]), shares)
        self.weights /= np.maximum(self.weights.sum(1, keepdims=True), 1e-9)

    def base(self, betas: torch.Tensor) -> FloatArray:
        """Rest vertices [19158,3] of the full base mesh."""
        phenotype = {name: betas[i : i + 1].double() for i, name in enumerate(self.body.beta_names)}
        with torch.no_grad():
            return np.asarray(self.model(phenotype_kwargs=phenotype)["rest_vertices"][0].double().numpy())

    def dress(self, rng: np.random.Generator) -> Person:
        """Draw a person."""
        woman = rng.random() < 0.5
        outfit = str(rng.choice(WOMEN if woman else MEN))
        hair = str(rng.choice(WOMENS_HAIR if woman else MENS_HAIR))
        betas = torch.tensor([
            rng.uniform(0.85, 1.0) if woman else rng.uniform(0.0, 0.15), rng.uniform(0.58, 0.9), rng.uniform(0.3, 0.75),
            rng.uniform(0.3, 0.75), rng.uniform(0.15, 0.6), rng.uniform(0.35, 0.75),
        ]).float()  # fmt: skip
        base = self.base(betas)
        hair_tone = np.array(HAIR_TONES[rng.integers(len(HAIR_TONES))]) * rng.uniform(0.8, 1.2)
        clothes = [read_garment(self.assets / "clothes" / outfit / f"{outfit}.mhclo")]
        shoes = f"shoes0{rng.integers(1, 7)}"
        clothes.append(read_garment(self.assets / "clothes" / shoes / f"{shoes}.mhclo"))
        worn = read_garment(self.assets / "hair" / hair / f"{hair}.mhclo")
        brows = f"eyebrow0{rng.integers(1, 13):02d}"
        brow = read_garment(self.assets / "eyebrows" / brows / f"{brows}.mhclo")
        parts = [self._skin(rng, betas, base, [*clothes, worn], worn, hair_tone)]
        parts += [self._part(garment, base, self._recoloured(rng, garment), False) for garment in clothes]
        parts += [self._part(garment, base, _toned(garment, hair_tone), True) for garment in (worn, brow)]
        return Person(betas, tuple(parts), outfit, hair)

    def _part(self, garment: Garment, base: FloatArray, texture: NDArray[np.uint8], cut: bool) -> Part:
        rest = garment.hang(base)
        tint = np.ones((len(rest), 3))
        return Part(rest, garment.weights(self.weights), garment.faces, garment.uvs, texture, tint, cut, garment)

    def _recoloured(self, rng: np.random.Generator, garment: Garment) -> NDArray[np.uint8]:
        """The garment's texture in other colours, or a plain, striped or checked one."""
        if garment.texture is None or rng.random() < 0.3:
            return _cloth(rng)
        texture = load_texture(garment.texture).copy()
        hsv = cv2.cvtColor(texture[..., :3], cv2.COLOR_RGB2HSV).astype(np.float64)
        hsv[..., 0] = (hsv[..., 0] + rng.uniform(0, 180)) % 180
        hsv[..., 1:] = np.clip(hsv[..., 1:] * rng.uniform((0.4, 0.6), (1.5, 1.5)), 0, 255)
        texture[..., :3] = cv2.cvtColor(hsv.astype(np.uint8), cv2.COLOR_HSV2RGB)
        texture[..., 3] = 255
        return texture

    def _skin(
        self,
        rng: np.random.Generator,
        betas: torch.Tensor,
        base: FloatArray,
        over: list[Garment],
        hair: Garment,
        tone: FloatArray,
    ) -> Part:
        """The body's own surface, less what clothes cover: one skin tone, lips, eyes, and a scalp under the hair."""
        body = self.body
        source = body.source_index.numpy()
        covered = np.isin(source, list(frozenset().union(*(garment.covers for garment in over))))
        faces = body.faces.numpy()
        shown = ~covered[faces].all(1)
        skin = np.array(SKIN_TONES[rng.integers(len(SKIN_TONES))]) * rng.uniform(0.85, 1.1)
        tint = np.tile(skin, (len(source), 1))
        tint *= 1 + 0.03 * rng.normal(size=(len(source), 1))
        rest = base[source]
        indices, weights = body.landmark_indices.numpy(), body.landmark_weights.numpy()
        marks = {n: (rest[i] * w[:, None]).sum(0) for n, i, w in zip(LANDMARK_NAMES, indices, weights, strict=True)}
        _paint_lips(tint, rest, marks["mouth_left"], marks["mouth_right"])
        _paint_eyes(tint, rest, body.regions["eyes"].numpy(), rng)
        strands = hair.hang(base)
        from scipy.spatial import cKDTree

        near = cKDTree(strands).query(rest)[0] < 0.012
        above = rest[:, 2] > marks["left_eye"][2] + 0.045
        behind = (rest[:, 1] > marks["left_ear"][1] - 0.005) & (rest[:, 2] > marks["mouth_left"][2])
        scalp = near & body.regions["head"].numpy() & (above | behind)
        tint[scalp] = tone
        uvs = np.zeros((len(faces), 3, 2))
        white = np.full((4, 4, 4), 255, np.uint8)
        return Part(None, None, faces[shown], uvs[shown], white, np.clip(tint, 0, 255) / 255, False)


@cache
def load_texture(path: Path) -> NDArray[np.uint8]:
    """RGBA [S,S,4] at `TEXTURE_SIZE`."""
    image = np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))
    if image.ndim == 2:
        image = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    image = cv2.resize(image, (TEXTURE_SIZE, TEXTURE_SIZE), interpolation=cv2.INTER_AREA)
    alpha = image[..., 3:] if image.shape[2] == 4 else np.full((*image.shape[:2], 1), 255, np.uint8)
    return np.concatenate([image[..., 2::-1], alpha], axis=2)


def _toned(garment: Garment, tone: FloatArray) -> NDArray[np.uint8]:
    """Hair in a given tone: the texture's own light and dark are kept."""
    if garment.texture is None:
        texture = np.full((4, 4, 4), 255, np.uint8)
        texture[..., :3] = np.clip(tone, 0, 255)
        return texture
    texture = load_texture(garment.texture).copy()
    grey = texture[..., :3].mean(-1, keepdims=True)
    solid = texture[..., 3] > 100
    grey = grey / max(float(grey[solid].mean()), 1.0)
    texture[..., :3] = np.clip(tone * np.clip(grey, 0.5, 1.6), 0, 255)
    return texture


def _cloth(rng: np.random.Generator) -> NDArray[np.uint8]:
    """Plain, striped or checked cloth."""
    first, second = rng.uniform(20, 235, (2, 3))
    if rng.random() < 0.5:
        first, second = np.full(3, first[0]), second
    rows, columns = np.mgrid[:TEXTURE_SIZE, :TEXTURE_SIZE] // int(rng.integers(6, 30))
    mix = [0 * rows, rows % 2, columns % 2, (rows + columns) % 2][rng.integers(4)][..., None]
    image = np.where(mix, second, first) + rng.normal(0, 4, (TEXTURE_SIZE, TEXTURE_SIZE, 1))
    alpha = np.full((TEXTURE_SIZE, TEXTURE_SIZE, 1), 255.0)
    return np.clip(np.concatenate([image, alpha], axis=2), 0, 255).astype(np.uint8)


def _paint_lips(tint: FloatArray, rest: FloatArray, left: FloatArray, right: FloatArray) -> None:
    middle, half = 0.5 * (left + right), 0.5 * np.linalg.norm(left - right)
    across, up = (rest[:, 0] - middle[0]) / half, (rest[:, 2] - middle[2]) / 0.010
    lips = (across**2 + up**2 < 1) & (rest[:, 1] < middle[1] + 0.01)
    tint[lips] *= [0.85, 0.6, 0.6]


def _paint_eyes(tint: FloatArray, rest: FloatArray, eyes: NDArray[np.bool_], rng: np.random.Generator) -> None:
    iris = np.array([(60, 38, 25), (70, 95, 120), (60, 80, 50)][rng.integers(3)])
    for side in (rest[:, 0] > 0, rest[:, 0] < 0):
        eye = np.flatnonzero(eyes & side)
        front = rest[eye][rest[eye, 1].argmin()]
        away = np.linalg.norm(rest[eye] - front, axis=1)
        tint[eye] = 235
        tint[eye[away < 0.0065]] = iris
        tint[eye[away < 0.003]] = 15
