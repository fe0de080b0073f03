"""The canonical views of a video's texture, as the prior sees them; and the symmetric fill that it has to beat."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ahoy_core.body.model import BodyModel
from ahoy_core.conventions import GREY
from ahoy_core.prior.bodymaps import light_maps
from ahoy_core.prior.completion import Pictures, canonical_context, repaint
from ahoy_core.prior.config import PriorConfig
from ahoy_core.prior.framing import HEIGHT, WIDTH
from ahoy_core.prior.selfcheck import SelfCheck, self_check
from ahoy_core.prior.video import VideoModel
from ahoy_core.texture.atlas import ObservedAtlas
from ahoy_core.texture.canonical import canonical_views
from ahoy_core.texture.fill import FillKind, fill_atlas
from ahoy_core.texture.light import shading
from ahoy_core.texture.surface import Surface
from ahoy_core.texture.texels import texel_map
from ahoy_core.texture.texture import canonical_vertices
from ahoy_core.texture.tones import vertex_normals

Array = NDArray[Any]

CLEAN_UP: Final = "prior, clean-up"
INVERSION: Final = "prior, inversion"
METHODS: Final[Mapping[str, Literal["clean-up", "inversion"]]] = {CLEAN_UP: "clean-up", INVERSION: "inversion"}
"""Competitor of the self-check -> the method of `PriorConfig` that it stands for."""


def ways(video: VideoModel) -> tuple[str, ...]:
    """The competitors that a prior can send: without an input for coarse latents, RF-inversion alone."""
    return (CLEAN_UP, INVERSION) if video.reads_bodies else (INVERSION,)


class CanonicalFill:
    """From what stays observed of a texture to its four canonical views, completed by symmetry and diffusion.

    Args:
        body: the run's body.
        betas: [S] the subject's shape.
        observed: the atlas of the video.
        size: height and width of the views, pixels; `VideoModel.size`.
        fill: as the texture was filled, see `fill_atlas`.
        light: likewise.

    Attributes:
        points: [N,3] of the atlas' texels in canonical pose, metres.
        observed: [N] bool, texels that the video showed.
        maps: body maps [1,4,7,H/4,W/4] of the four views, front, left, back, right.
        azimuth: [1,4] radians.
    """

    def __init__(
        self,
        body: BodyModel,
        betas: Array,
        observed: ObservedAtlas,
        size: tuple[int, int] = (HEIGHT, WIDTH),
        fill: FillKind = "both",
        light: bool = True,
    ) -> None:
        self._atlas, self._size, self._fill, self._light = observed, size, fill, light
        self._surface = Surface.of(body)
        self._texels = texel_map(self._surface, len(observed.coverage))
        self._vertices = canonical_vertices(body, betas)
        self.points = self._texels.points(self._vertices, self._surface.faces)
        self.observed: Array = observed.coverage.ravel()[self._texels.flat] > 0
        self._body, self._normals = body, vertex_normals(self._surface, self._vertices)
        self.maps, self.azimuth = canonical_context(body, torch.from_numpy(self._vertices), size)

    def __call__(self, kept: Tensor) -> Pictures:
        """The completed views if only the texels `kept` [N] had been observed, and the light that those tell of."""
        size = len(self._atlas.coverage)
        known: Array = np.zeros(size * size, dtype=bool)
        known[self._texels.flat[kept.numpy()]] = True
        known = known.reshape(size, size)
        atlas = ObservedAtlas(
            rgb=np.where(known[..., None], self._atlas.rgb, 0).astype(np.uint8),
            coverage=np.where(known, self._atlas.coverage, 0).astype(np.float32),
            source_frame=np.where(known, self._atlas.source_frame, -1).astype(np.int32),
        )
        filled = fill_atlas(atlas, self._surface, self._texels, self._vertices, self._fill, self._light)
        made = canonical_views(self._surface, self._texels, self._vertices, atlas, filled.rgb, *self._size)
        rgba = torch.from_numpy(made.views).permute(0, 3, 1, 2).float() / 255
        alpha = rgba[:, 3:]
        coverage = torch.from_numpy(made.coverage)[:, None].float() / 255
        posed = torch.from_numpy(self._vertices).expand(4, -1, -1)
        light = light_maps(self._body, posed, made.cameras, shading(self._normals, np.array(filled.light)))
        return Pictures(rgba[:, :3] * alpha + GREY * (1 - alpha), alpha, coverage, moving=False, light=light)


def check_prior(video: VideoModel, fill: CanonicalFill, regions: int, seed: int = 0) -> SelfCheck:
    """The prior's ways against the symmetric fill on hidden parts of what a video showed.

    The clean-up takes part where the prior reads coarse latents.
    """

    def by(config: PriorConfig) -> Any:
        return lambda given: repaint(video, given, fill.maps, fill.azimuth, config)

    rivals = {name: by(PriorConfig(method=METHODS[name], seed=seed)) for name in ways(video)}
    return self_check(fill.points, fill.observed, fill, rivals, np.random.default_rng(seed), regions)
