"""What the prior says of the canonical views, carried back to the texture."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ahoy_core.conventions import canonical_cameras
from ahoy_core.prior.completion import Pictures
from ahoy_core.texture.atlas import ObservedAtlas
from ahoy_core.texture.rays import Caster, to_camera, to_pixels, view_cosines
from ahoy_core.texture.surface import Surface
from ahoy_core.texture.texels import TexelMap, pad_charts, sample_image

Array = NDArray[Any]

_GRAZING: Final = 0.1  # cosine below which a view says nothing of a texel
_INSIDE: Final = 0.5  # alpha from which a pixel shows the person
_UNSEEN_WEIGHT: Final = 1e-4  # of a view that looks towards a texel but has something before it: better than nothing


def recoloured_atlas(
    observed: ObservedAtlas,
    filled_rgb: Array,
    surface: Surface,
    texels: TexelMap,
    vertices: Array,
    given: Pictures,
    made: Tensor,
) -> Array:
    """Adds to the unobserved texels of a filled atlas what the prior changed in its canonical views.

    The views are coarse (128 x 64), so only the *difference* is carried over: fine detail stays that of the fill,
    and observed texels stay bit by bit.

    Args:
        observed: what the video showed.
        filled_rgb: [A,A,3] uint8, the fill.
        surface: the body's triangles.
        texels: the atlas' texels on them.
        vertices: [V,3] canonical pose, metres.
        given: the fill's four canonical views at the prior's size.
        made: [4,3,H,W] what the prior made of them.

    Returns:
        [A,A,3] uint8, charts padded.
    """
    height, width = made.shape[2:]
    cameras = canonical_cameras(torch.from_numpy(vertices), height, width)
    points, change = texels.points(vertices, surface.faces), np.zeros((len(texels.face), 3))
    total = np.zeros(len(texels.face))
    for view in range(len(made)):
        viewmat, K = cameras.viewmats[view].numpy(), cameras.Ks[view].numpy()
        caster = Caster(to_camera(vertices, viewmat), surface.faces, "ortho")
        there = to_camera(points, viewmat)
        cosine = view_cosines(there, caster.normals[texels.face], "ortho")
        weight = np.where(cosine > _GRAZING, cosine**2, 0)
        weight = weight * np.where(caster.sees(there, texels.face), 1.0, _UNSEEN_WEIGHT)
        difference = ((made[view] - given.frames[view]) * (1 - given.coverage[view])).permute(1, 2, 0).numpy()
        inside = (given.mask[view, 0] > _INSIDE).numpy()
        change += weight[:, None] * sample_image(pad_charts(difference, inside), to_pixels(there, K, "ortho"))
        total += weight
    change *= 255 / np.maximum(total, 1e-9)[:, None]
    unseen = observed.coverage.ravel()[texels.flat] <= 0
    rgb = filled_rgb.reshape(-1, 3).astype(np.float64)
    rgb[texels.flat[unseen]] += change[unseen]
    recoloured = np.clip(np.rint(rgb), 0, 255).astype(np.uint8).reshape(filled_rgb.shape)
    return pad_charts(recoloured, texels.chart)
