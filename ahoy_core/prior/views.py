"""The prior in the roles "views" and "inpaint": a person turned round, and a front completed (paper, section 3.1)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ahoy_core.prior.completion import Pictures, composited, repaint
from ahoy_core.prior.config import PriorConfig
from ahoy_core.prior.video import VideoModel
from ahoy_core.texture.fillings import AZIMUTHS


@dataclass(frozen=True)
class PriorBody:
    """One person before the prior: its canonical views as far as a video showed them, and the body that is in them.

    Attributes:
        video: the prior.
        pictures: the four canonical views, front, left, back, right, completed by a coarse fill.
        maps: [1,4,7,H/4,W/4] body maps of the views.
        azimuth: [1,4] radians.
        config: how the prior is asked.
    """

    video: VideoModel
    pictures: Pictures
    maps: Tensor
    azimuth: Tensor
    config: PriorConfig

    def completed(self) -> Tensor:
        """The views [4,3,H,W] as the prior completes them, what was observed pasted over."""
        made = repaint(self.video, self.pictures, self.maps, self.azimuth, self.config)
        return composited(made, self.pictures)

    def views(self, image: Tensor, mask: Tensor) -> tuple[Tensor, tuple[float, ...]]:
        """Role "views": the person from four sides over grey 0.5, [4,3,H,W] in [0,1], and their azimuths in degrees.

        Args:
            image: [3,H,W] the completed front view, taken as observed.
            mask: [1,H,W] its silhouette.

        Raises:
            ValueError: for another size than that of the canonical views.
        """
        self._check(image, mask)
        return self._with_front(image, mask, mask).completed(), AZIMUTHS

    def inpaint(self, image: Tensor, mask: Tensor, prompt: str = "", seed: int = 0) -> Tensor:
        """Role "inpaint": the canonical front view with its masked pixels as the prior completes them.

        Args:
            image: [3,H,W] in [0,1], the front view where it was observed.
            mask: [1,H,W], 1 = fill.
            prompt: not used: the embedded prior's own words for a person are.
            seed: of the noise.

        Raises:
            ValueError: for another size than that of the canonical views.
        """
        seeded = replace(self, config=self.config.model_copy(update={"seed": seed}))
        self._check(image, mask)
        silhouette = self.pictures.mask[0]
        return seeded._with_front(image, silhouette, silhouette * (1 - mask)).completed()[0]

    def _with_front(self, image: Tensor, silhouette: Tensor, observed: Tensor) -> PriorBody:
        given = self.pictures
        # What the given front leaves open keeps the coarse fill as the prior's first guess.
        front = image * observed + given.frames[0] * (1 - observed)
        pictures = replace(
            given,
            frames=torch.cat([front[None], given.frames[1:]]),
            mask=torch.cat([silhouette[None], given.mask[1:]]),
            coverage=torch.cat([observed[None], given.coverage[1:]]),
        )
        return replace(self, pictures=pictures)

    def _check(self, image: Tensor, mask: Tensor) -> None:
        given = self.pictures
        if image.shape != given.frames.shape[1:] or mask.shape != given.mask.shape[1:]:
            raise ValueError(
                f"expected image {tuple(given.frames.shape[1:])} and mask of the canonical views' size, got "
                f"{tuple(image.shape)} and {tuple(mask.shape)}; render them with the same camera"
            )
