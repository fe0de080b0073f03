"""The atlas's texels as points of the body's surface, and colours looked up in an atlas.

Row 0 of an atlas is the top of the picture, v = 1; texel (r, c) of A x A has its centre at u = (c + .5) / A, v = 1 -
(r + .5) / A.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ahoy_core.texture.rays import BoolArray, Caster, FloatArray, IntArray, face_normals
from ahoy_core.texture.surface import Surface


@dataclass(frozen=True)
class TexelMap:
    """The N texels of an A x A atlas that lie on the body's surface.

    flat [N] row * A + column, face [N], bary [N,3] weights of the face's corners.
    """

    size: int
    flat: IntArray
    face: IntArray
    bary: FloatArray

    @property
    def chart(self) -> BoolArray:
        """[A,A] bool: the texel belongs to the surface."""
        chart = np.zeros(self.size * self.size, dtype=bool)
        chart[self.flat] = True
        return chart.reshape(self.size, self.size)

    def points(self, vertices: FloatArray, faces: IntArray) -> FloatArray:
        """Points [N,3] of the texels on a mesh of vertices [V,3]."""
        return (vertices[faces[self.face]] * self.bary[:, :, None]).sum(axis=1)

    def areas(self, vertices: FloatArray, surface: Surface) -> FloatArray:
        """Surface area [N] in square metres of each texel: its face's area, shared among the face's texels."""
        a, b, c = (vertices[surface.faces[:, i]] for i in range(3))
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
        texels_of_face = np.bincount(self.face, minlength=len(area))
        return area[self.face] / texels_of_face[self.face]


def texel_map(surface: Surface, size: int) -> TexelMap:
    """Rasterize the UV layout once: which face, and where in it, is each texel's centre?

    Rays fall on the flat layout, so that the same code decides coverage here and in the frames. Faces that are never
    textured take no texel. Where charts overlap, one face owns the texel and the others share its colour.
    """
    if size < 1:
        raise ValueError(f"expected an atlas of at least one texel, got size {size}")
    owners = np.flatnonzero(surface.textured)
    flat_mesh = np.pad(surface.uvs, ((0, 0), (0, 1)))
    caster = Caster(flat_mesh, surface.uv_faces[owners], "ortho")
    rows, cols = np.mgrid[0:size, 0:size]
    centres = np.stack([(cols.ravel() + 0.5) / size, 1 - (rows.ravel() + 0.5) / size, np.zeros(size * size)], axis=1)
    hits = caster.cast(centres)
    found = np.flatnonzero(hits.face >= 0)
    return TexelMap(size, found, owners[hits.face[found]], hits.bary[found])


def texel_normals(texels: TexelMap, vertices: FloatArray, surface: Surface) -> FloatArray:
    """Outward unit normals [N,3] of the texels' faces."""
    return face_normals(vertices, surface.faces)[texels.face]


def pad_charts(atlas: FloatArray, known: BoolArray) -> FloatArray:
    """Give every texel outside `known` the colour of the nearest known one: lookups at a border bleed no emptiness.

    Args:
        atlas: [A,A,D] or [A,A], any dtype.
        known: [A,A] bool. Nothing known returns the atlas as it is.
    """
    if known.all() or not known.any():
        return atlas
    _, labels = cv2.distanceTransformWithLabels(
        (~known).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE, labelType=cv2.DIST_LABEL_PIXEL
    )
    # Every known texel got a label of its own; the table turns a label back into the texel.
    source = np.zeros(labels.max() + 1, dtype=np.int64)
    source[labels[known]] = np.flatnonzero(known)
    flat: FloatArray = atlas.reshape(atlas.shape[0] * atlas.shape[1], -1)
    return flat[source[labels]].reshape(atlas.shape)


def sample_image(image: FloatArray, pixels: FloatArray) -> FloatArray:
    """Bilinear lookup at pixels [N,2] (x, y; centres at +0.5), clamped at the border.

    Args:
        image: [H,W,D] or [H,W], any dtype.
        pixels: [N,2] finite.

    Returns:
        [N,D] or [N] float32, in the image's range.
    """
    height, width = image.shape[:2]
    x = np.clip(pixels[:, 0] - 0.5, 0, width - 1)
    y = np.clip(pixels[:, 1] - 0.5, 0, height - 1)
    x0, y0 = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    x1, y1 = np.minimum(x0 + 1, width - 1), np.minimum(y0 + 1, height - 1)
    fx, fy = (x - x0).astype(np.float32), (y - y0).astype(np.float32)
    if image.ndim == 3:
        fx, fy = fx[:, None], fy[:, None]
    top = image[y0, x0] * (1 - fx) + image[y0, x1] * fx
    bottom = image[y1, x0] * (1 - fx) + image[y1, x1] * fx
    return (top * (1 - fy) + bottom * fy).astype(np.float32)


def sample_atlas(atlas: FloatArray, uv: FloatArray) -> FloatArray:
    """Colours at surface points, bilinear.

    The atlas has to be padded (`pad_charts`; `Texture.filled_rgb` is): a lookup at a chart's border reads one texel
    beyond it.

    Args:
        atlas: [A,A,D] or [A,A], row 0 at v = 1.
        uv: [N,2] in [0,1], origin at the lower left.

    Returns:
        [N,D] or [N] float32, in the atlas's range.
    """
    height, width = atlas.shape[:2]
    return sample_image(atlas, np.stack([uv[:, 0] * width, (1 - uv[:, 1]) * height], axis=1))


def face_coverage(coverage: FloatArray, texels: TexelMap, surface: Surface) -> FloatArray:
    """Observed share [F] of each triangle, from the coverage [A,A] of an atlas, looked up at the triangle's middle.

    Most triangles are smaller than a texel, so counting a triangle's own texels would find none.
    """
    seen = pad_charts((coverage > 0).astype(np.float32), texels.chart)
    share: FloatArray = sample_atlas(seen, surface.uvs[surface.uv_faces].mean(axis=1)) * surface.textured
    return share
