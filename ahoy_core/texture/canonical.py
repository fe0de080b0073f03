"""The canonical views (paper section 3.1): the textured body in the pose theta_*, seen by four orthographic cameras.

The front view with observed texels alone is the paper's I_*^part; the views of the completed atlas are the embedded
baseline of the role "views" (the paper asks a multi-view diffusion model for the three other sides).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch

from ahoy_core.conventions import Cameras, canonical_cameras
from ahoy_core.texture.atlas import ObservedAtlas
from ahoy_core.texture.rays import Caster, FloatArray, IntArray, hit_map, to_camera
from ahoy_core.texture.surface import Surface, interpolate_uv
from ahoy_core.texture.texels import TexelMap, pad_charts, sample_atlas

# An observed share of at least this much of a pixel makes it observed in I_*^part.
OBSERVED_SHARE = 0.5
# Colour of what is never textured (inside of the mouth, eye sockets), where a view looks at it: dark, as a mouth is.
INTERIOR = (70.0, 40.0, 38.0)


@dataclass(frozen=True)
class CanonicalViews:
    """The four views: front, left, back, right.

    views [4,H,W,4] uint8 RGBA, straight alpha; coverage [4,H,W] uint8, observed share of each pixel; partial [H,W,4]
    uint8, the front view where it was observed (I_*^part); cameras, orthographic.
    """

    views: IntArray
    coverage: IntArray
    partial: IntArray
    cameras: Cameras


def canonical_views(
    surface: Surface,
    texels: TexelMap,
    vertices: FloatArray,
    observed: ObservedAtlas,
    filled_rgb: IntArray,
    height: int,
    width: int,
    supersample: int = 2,
) -> CanonicalViews:
    """Render the canonical body from its four sides.

    Args:
        surface: the body's triangles.
        texels: the atlas's texels on them.
        vertices: [V,3] canonical pose, world, metres.
        observed: what was seen.
        filled_rgb: [A,A,3] uint8, complete and padded.
        height: pixels.
        width: pixels.
        supersample: rays a pixel and axis; smooth silhouettes need at least 2.
    """
    cameras = canonical_cameras(torch.from_numpy(np.asarray(vertices, dtype=np.float32)), height, width)
    seen = observed.coverage > 0
    seen_share = pad_charts(seen.astype(np.float32), texels.chart)
    # Padded from what was seen, so that a pixel half seen is not darkened by the empty half.
    observed_rgb = pad_charts(observed.rgb, seen)
    views = np.zeros((4, height, width, 4), dtype=np.uint8)
    coverage = np.zeros((4, height, width), dtype=np.uint8)
    partial = np.zeros((height, width, 4), dtype=np.uint8)
    for view in range(4):
        viewmat, K = cameras.viewmats[view].numpy(), cameras.Ks[view].numpy()
        texture = _Layers(filled_rgb, observed_rgb, seen_share)
        filled, known, share = _render(surface, vertices, viewmat, K, height, width, supersample, texture)
        views[view], coverage[view] = filled, np.rint(share * 255)
        if view == 0:
            shown = (share >= OBSERVED_SHARE) & (known[..., 3] > 0)
            partial = np.where(shown[..., None], known, 0).astype(np.uint8)
    return CanonicalViews(views, coverage, partial, cameras)


@dataclass(frozen=True)
class _Layers:
    filled: IntArray
    observed: IntArray
    share: FloatArray


def _render(
    surface: Surface,
    vertices: FloatArray,
    viewmat: FloatArray,
    K: FloatArray,
    height: int,
    width: int,
    supersample: int,
    atlas: _Layers,
) -> tuple[IntArray, IntArray, FloatArray]:
    """One view: RGBA [H,W,4] of the filled and of the observed atlas, and each pixel's observed share [H,W]."""
    fine_K = np.array(K, dtype=np.float64)
    fine_K[:2] *= supersample
    fine = height * supersample, width * supersample
    hits = hit_map(Caster(to_camera(vertices, viewmat), surface.faces, "ortho"), fine_K, fine[1], fine[0])
    body = hits.face >= 0
    face = hits.face[body]
    uv = interpolate_uv(surface, face, hits.bary[body])
    textured = surface.textured[face]
    alpha = body.astype(np.float32)
    share = np.zeros(fine, dtype=np.float32)
    share[body] = sample_atlas(atlas.share, uv) * textured
    filled = np.where(textured[:, None], sample_atlas(atlas.filled, uv), np.array(INTERIOR, dtype=np.float32))
    known = sample_atlas(atlas.observed, uv)
    small = (width, height)
    alpha_small = cv2.resize(alpha, small, interpolation=cv2.INTER_AREA)
    share_small = cv2.resize(share, small, interpolation=cv2.INTER_AREA)
    images = []
    for colour, weight, opacity in ((filled, alpha, alpha_small), (known, share, (share_small > 0) * alpha_small)):
        weighted = np.zeros((*fine, 3), dtype=np.float32)
        weighted[body] = colour * weight[body][:, None]
        images.append(_straight(cv2.resize(weighted, small, interpolation=cv2.INTER_AREA), weight, opacity, small))
    return images[0], images[1], share_small / np.maximum(alpha_small, 1e-6)


def _straight(weighted: FloatArray, weight: FloatArray, opacity: FloatArray, small: tuple[int, int]) -> IntArray:
    """RGBA uint8 with straight alpha from weighted colours, their weights (fine) and the wanted opacity."""
    total = cv2.resize(weight, small, interpolation=cv2.INTER_AREA)[..., None]
    colour = np.where(total > 0, weighted / np.maximum(total, 1e-6), 0)
    rgba = np.concatenate([colour, 255 * opacity[..., None]], axis=2)
    return np.clip(np.rint(rgba), 0, 255).astype(np.uint8)
