"""Face views out of the head's own texture: the embedded default of the role "face" (paper section 3.3).

A generator of faces invents what the video never showed of one. Here nothing of a face is invented: the head's texture
is reprojected to cameras all round it. What the video showed counts; of what it did not show, hair and the back of the
head may come from the prior, which has seen those; a face that was never seen is left alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt

from ahoy_core.avatar.face_role import DISTANCE, face_cameras
from ahoy_core.avatar.head import FaceViews
from ahoy_core.avatar.supervision import CoarseInputs
from ahoy_core.conventions import GREY, Cameras
from ahoy_core.maps.template import Template
from ahoy_core.texture.rays import BoolArray, Caster, FloatArray, IntArray, face_normals, hit_map, to_camera
from ahoy_core.texture.surface import PARTS, Surface, interpolate_uv
from ahoy_core.texture.texels import TexelMap, face_coverage, pad_charts, sample_atlas, texel_map
from ahoy_core.texture.texture import canonical_vertices
from ahoy_core.texture.tones import FACE_SPAN

AZIMUTHS: Final = tuple(float(a) for a in range(-180, 180, 30))
"""Degrees. All round, unlike those of a generator of faces: here the back of the head is known, or at least filled."""
SHARE: Final = 0.15
"""Of the head's weight; as `face_views.SHARE`, for the same reason."""
FILLED: Final = 0.3
"""Weight of a pixel that the prior filled; observed: 1. As `LossWeights.filled` in the coarse objective."""
GRAZING: Final = 0.3
"""Cosine below which a pixel is left out: there a bare head and one with hair on it differ most."""
MARGIN: Final = 0.01
"""Metres inside the bare head's outline (and the neck's cut) that are left out: the outline of hair is another."""
MIN_AREA: Final = 64
"""Pixels that count; a view with fewer says nothing."""
_WHOLE: Final = 1 - 1e-3  # a bilinear lookup that touches only texels of one kind gives 1, up to rounding


@dataclass(frozen=True)
class HeadTexture:
    """Face views of the head's texture, and how much of the head they rest on.

    Attributes:
        views: None where there is nothing to show.
        reason: Why there is none.
        observed: Share of the bare head's area that the video showed, [0,1].
        filled: Share that the prior filled: hair and back of the head alone.
    """

    views: FaceViews | None
    reason: str
    observed: float = 0.0
    filled: float = 0.0


class _Head(NamedTuple):
    """The person's bare mesh: triangles, vertices [V,3] in canonical pose, and the triangles' normals [F,3]."""

    surface: Surface
    vertices: FloatArray
    normals: FloatArray

    @classmethod
    def of(cls, inputs: CoarseInputs) -> _Head:
        """The head of the person that inputs are of."""
        surface, vertices = Surface.of(inputs.body), canonical_vertices(inputs.body, inputs.betas.numpy())
        return cls(surface, vertices, face_normals(vertices, surface.faces))

    def may_be_filled(self, points: FloatArray, triangles: IntArray) -> BoolArray:
        """[N] where a prior may say what points [N,3] on triangles [N] look like: hair and the back of the head.

        Above the hairline, or on the half behind and looking back: neither the face (`tones.face_points`) nor what is
        beside it (cheeks, temples, nostrils), which is a face to whoever looks at it.
        """
        own, normals = self.vertices[self.surface.head], self.normals[triangles]
        head = np.all(self.surface.head[self.surface.faces[triangles]], axis=1)
        (_, front, low), (_, rear, high) = own.min(axis=0), own.max(axis=0)
        above = points[:, 2] > low + FACE_SPAN[1] * (high - low)
        behind = (normals[:, 1] > 0) & (points[:, 1] > (front + rear) / 2)
        hair: BoolArray = head & (above | behind)
        return hair


class _Layers(NamedTuple):
    """Padded atlases: colour [A,A,3] of known texels alone; share [A,A] that the video showed, that a prior filled."""

    colour: FloatArray
    seen: FloatArray
    filled: FloatArray


@torch.no_grad()
def reprojected_faces(inputs: CoarseInputs, template: Template, prior_filled: bool, side: int = 128) -> HeadTexture:
    """The completed texture of the head before the face cameras, weighted by where its colours are from.

    Args:
        inputs: body, shape, completed atlas and its coverage.
        template: the bare body.
        prior_filled: the atlas was completed by a prior that won the self-check (or was believed): else what the video
            did not show has no weight at all.
        side: pixels of the square pictures.
    """
    head = _Head.of(inputs)
    if not head.surface.head.any() or not bool(template.head.any()):
        return HeadTexture(None, "the body has no head")
    texels = texel_map(head.surface, len(inputs.atlas_coverage))
    seen: BoolArray = inputs.atlas_coverage.numpy().ravel()[texels.flat] > 0
    filled = prior_filled & ~seen & head.may_be_filled(texels.points(head.vertices, head.surface.faces), texels.face)
    shares = _shares(head, inputs, texels, prior_filled)
    if sum(shares) == 0:
        return HeadTexture(None, "no part of the head was observed, or filled by a prior")
    layers = _layers(inputs, texels, seen, filled)
    cameras = face_cameras(template, side, AZIMUTHS)
    made = [_view(head, layers, cameras[n]) for n in range(len(cameras))]
    kept = [n for n, (_, weight, _) in enumerate(made) if float(weight.sum()) >= MIN_AREA]
    if not kept:
        return HeadTexture(None, "too little of the head was observed, or filled by a prior", *shares)
    weights = torch.stack([torch.from_numpy(made[n][1]) for n in kept])
    heads = torch.tensor([made[n][2] for n in kept])
    views = FaceViews(
        images=torch.stack([torch.from_numpy(made[n][0]).permute(2, 0, 1) for n in kept]),
        alphas=(weights > 0).float(),
        weights=weights,
        cameras=cameras[kept],
        relative=torch.eye(4).expand(len(kept), inputs.body.n_joints, 4, 4),
        expression=torch.zeros(len(kept), inputs.body.n_expressions),
        # The loss is a mean over the pixels that count: few of them shall not weigh as much as a whole head.
        shares=SHARE * weights.sum((1, 2)) / heads,
    )
    return HeadTexture(views, "", *shares)


def head_observed(inputs: CoarseInputs) -> float:
    """Share of the bare head's area that the video showed, [0,1]; 0 for a body without a head."""
    head = _Head.of(inputs)
    return _shares(head, inputs, texel_map(head.surface, len(inputs.atlas_coverage)), prior_filled=False)[0]


def _shares(head: _Head, inputs: CoarseInputs, texels: TexelMap, prior_filled: bool) -> tuple[float, float]:
    """Shares of the bare head's area that the video showed, and that a prior filled; by triangles, not by texels."""
    surface = head.surface
    own = np.flatnonzero((surface.part == PARTS.index("head")) & surface.textured)
    a, b, c = (head.vertices[surface.faces[own, corner]] for corner in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    seen = face_coverage(inputs.atlas_coverage.numpy(), texels, surface)[own]
    filled = prior_filled * (1 - seen) * head.may_be_filled((a + b + c) / 3, own)
    whole = max(float(areas.sum()), 1e-12)
    return float((areas * seen).sum()) / whole, float((areas * filled).sum()) / whole


def _layers(inputs: CoarseInputs, texels: TexelMap, seen: BoolArray, filled: BoolArray) -> _Layers:
    def spread(values: BoolArray) -> BoolArray:
        whole = np.zeros(texels.size * texels.size, dtype=bool)
        whole[texels.flat[values]] = True
        return whole.reshape(texels.size, texels.size)

    colour = pad_charts(inputs.atlas.permute(1, 2, 0).numpy(), spread(seen | filled))
    return _Layers(colour, *(pad_charts(spread(kind).astype(np.float32), texels.chart) for kind in (seen, filled)))


def _view(head: _Head, layers: _Layers, camera: Cameras) -> tuple[FloatArray, FloatArray, int]:
    """Picture [S,S,3] over grey, weights [S,S], and pixels of head in it."""
    surface, K = head.surface, camera.Ks[0].numpy()
    caster = Caster(to_camera(head.vertices, camera.viewmats[0].numpy()), surface.faces)
    hits = hit_map(caster, K, camera.width, camera.height)
    own = (hits.face >= 0) & (surface.part[hits.face] == PARTS.index("head"))
    inside = distance_transform_edt(own) > MARGIN * float(K[0, 0]) / DISTANCE
    shown = own & inside & (hits.cosine >= GRAZING) & surface.textured[hits.face]
    colour, weight = _looked_up(head, layers, hits.face[shown], hits.bary[shown])
    image = np.full((*own.shape, 3), GREY, dtype=np.float32)
    weights = np.zeros(own.shape, dtype=np.float32)
    weights[shown] = weight
    image[shown] = np.where(weight[:, None] > 0, colour, GREY)
    return image, weights, int(own.sum())


def _looked_up(head: _Head, layers: _Layers, face: IntArray, bary: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Colours [N,3] and weights [N] of points on triangles; a weight only where every texel touched is known."""
    colour, seen, filled = (sample_atlas(layer, interpolate_uv(head.surface, face, bary)) for layer in layers)
    points = (head.vertices[head.surface.faces[face]] * bary[:, :, None]).sum(axis=1)
    # Texels are coarser than triangles: the edge of a fill must not reach into the face beside it.
    known = head.may_be_filled(points, face) & (seen + filled >= _WHOLE)
    weight = np.where(seen >= _WHOLE, 1, np.where(known, seen + FILLED * filled, 0))
    return colour, weight.astype(np.float32)
