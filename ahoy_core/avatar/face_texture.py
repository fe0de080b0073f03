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
from ahoy_core.texture.rays import BoolArray, Caster, FloatArray, HitMap, hit_map, to_camera
from ahoy_core.texture.surface import PARTS, Surface, interpolate_uv
from ahoy_core.texture.texels import TexelMap, pad_charts, sample_atlas, texel_map, texel_normals
from ahoy_core.texture.texture import canonical_vertices
from ahoy_core.texture.tones import FACE_SPAN, face_points

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


class _Kinds(NamedTuple):
    """Of N texels, bool: on the head, in the face, shown by the video, filled by a prior that may fill there."""

    head: BoolArray
    face: BoolArray
    seen: BoolArray
    filled: BoolArray


class _Layers(NamedTuple):
    """Padded atlases [A,A,...]: colour of known texels alone, and which texels are of the face, seen, filled."""

    colour: FloatArray
    face: FloatArray
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
    surface = Surface.of(inputs.body)
    if not surface.head.any() or not bool(template.head.any()):
        return HeadTexture(None, "the body has no head")
    vertices = canonical_vertices(inputs.body, inputs.betas.numpy())
    texels = texel_map(surface, len(inputs.atlas_coverage))
    kinds = _kinds(inputs, surface, texels, vertices, prior_filled)
    areas = texels.areas(vertices, surface) * kinds.head
    observed, filled = (float(areas[kind].sum() / max(areas.sum(), 1e-12)) for kind in (kinds.seen, kinds.filled))
    if not (kinds.head & (kinds.seen | kinds.filled)).any():
        return HeadTexture(None, "no part of the head was observed, or filled by a prior")
    layers = _layers(inputs, texels, kinds)
    cameras = face_cameras(template, side, AZIMUTHS)
    made = [_view(surface, vertices, layers, cameras[n]) for n in range(len(cameras))]
    kept = [n for n, (_, weight, _) in enumerate(made) if float(weight.sum()) >= MIN_AREA]
    if not kept:
        return HeadTexture(None, "too little of the head was observed, or filled by a prior", observed, filled)
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
    return HeadTexture(views, "", observed, filled)


def _kinds(
    inputs: CoarseInputs, surface: Surface, texels: TexelMap, vertices: FloatArray, prior_filled: bool
) -> _Kinds:
    points, normals = texels.points(vertices, surface.faces), texel_normals(texels, vertices, surface)
    head = np.all(surface.head[surface.faces[texels.face]], axis=1)
    heights = vertices[surface.head][:, 2]
    face = face_points(points, normals, head, heights)
    above = points[:, 2] > heights.min() + FACE_SPAN[1] * (heights.max() - heights.min())
    seen: BoolArray = inputs.atlas_coverage.numpy().ravel()[texels.flat] > 0
    # Neither the face nor what looks ahead beside it (cheeks, temples): those are a face to whoever looks at them.
    hair = head & ~face & (above | (normals[:, 1] > 0))
    return _Kinds(head, face, seen, hair & ~seen & prior_filled)


def _layers(inputs: CoarseInputs, texels: TexelMap, kinds: _Kinds) -> _Layers:
    size = texels.size

    def spread(values: BoolArray) -> BoolArray:
        whole = np.zeros(size * size, dtype=bool)
        whole[texels.flat[values]] = True
        return whole.reshape(size, size)

    colour = inputs.atlas.permute(1, 2, 0).numpy()
    face, seen, filled = (
        pad_charts(spread(kind).astype(np.float32), texels.chart) for kind in (kinds.face, kinds.seen, kinds.filled)
    )
    return _Layers(pad_charts(colour, spread(kinds.seen | kinds.filled)), face, seen, filled)


def _view(
    surface: Surface, vertices: FloatArray, layers: _Layers, camera: Cameras
) -> tuple[FloatArray, FloatArray, int]:
    """Picture [S,S,3] over grey, weights [S,S], and pixels of head in it."""
    K = camera.Ks[0].numpy()
    caster = Caster(to_camera(vertices, camera.viewmats[0].numpy()), surface.faces)
    hits = hit_map(caster, K, camera.width, camera.height)
    head = (hits.face >= 0) & (surface.part[hits.face] == PARTS.index("head"))
    inside = distance_transform_edt(head) > MARGIN * float(K[0, 0]) / DISTANCE
    shown = head & inside & (hits.cosine >= GRAZING) & surface.textured[hits.face]
    colour, weight = _looked_up(surface, layers, hits, shown)
    image = np.full((*head.shape, 3), GREY, dtype=np.float32)
    weights = np.zeros(head.shape, dtype=np.float32)
    weights[shown] = weight
    image[shown] = np.where(weight[:, None] > 0, colour, GREY)
    return image, weights, int(head.sum())


def _looked_up(surface: Surface, layers: _Layers, hits: HitMap, shown: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Colours [N,3] and weights [N] of the pixels that are shown; a weight only where every texel touched is known."""
    uv = interpolate_uv(surface, hits.face[shown], hits.bary[shown])
    colour, face, seen, filled = (sample_atlas(layer, uv) for layer in layers)
    weight = np.where(seen + filled >= _WHOLE, seen + FILLED * filled, 0)
    # Of a face, not even the edge of a fill beside it.
    return colour, np.where((face > 0) & (seen < _WHOLE), 0, weight).astype(np.float32)
