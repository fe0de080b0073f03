"""Pictures without the light that a person was seen in, for a prior that cannot tell a dark cloth from a dark side.

Colours of textures and avatars hold that light, whatever the pose: it is a function of the normal in the canonical one
(`ahoy_core.texture.light`). A person carries it about.
"""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray
from torch import Tensor

from ahoy_core.body.model import BodyModel
from ahoy_core.conventions import GREY
from ahoy_core.texture.light import shading
from ahoy_core.texture.surface import Surface
from ahoy_core.texture.texture import canonical_vertices
from ahoy_core.texture.tones import vertex_normals

Array = NDArray[Any]


def brightness_on(body: BodyModel, betas: Array, slope: Array) -> Array:
    """Brightness [V] of a body's vertices as a share of each colour's own, whatever its pose.

    Args:
        body: of V vertices.
        betas: [S] its shape.
        slope: [3] of brightness over the canonical normal, see `ahoy_core.texture.light.estimate_light`.
    """
    return shading(vertex_normals(Surface.of(body), canonical_vertices(body, betas)), slope)


def unlit(frames: Tensor, mask: Tensor, light: Tensor | None) -> Tensor:
    """Frames with the person as it would be in even light.

    Args:
        frames: [T,3,H,W] in [0,1] over grey.
        mask: [T,1,H,W] alpha of the person.
        light: [T,1,H,W] of `ahoy_core.prior.bodymaps.light_maps`; None: not known, and left.
    """
    return frames if light is None else _times(frames, mask, 1 / light)


def lit(frames: Tensor, mask: Tensor, light: Tensor | None) -> Tensor:
    """The inverse of `unlit`, but for what has become too bright for a picture."""
    return frames if light is None else _times(frames, mask, light)


def _times(frames: Tensor, mask: Tensor, factor: Tensor) -> Tensor:
    grey = GREY * (1 - mask)
    return ((frames - grey) * factor + grey).clamp(0, 1)
