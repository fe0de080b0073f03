"""The embedded fillings of the roles "inpaint" and "views": the completed atlas, seen from its four sides.

Both are what a generative prior has to beat. They are made once a person and then have the roles' contracts: thin
shells round the canonical views.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ahoy_core.texture.canonical import CanonicalViews

AZIMUTHS = (0.0, 90.0, 180.0, 270.0)


@dataclass(frozen=True)
class TexturedBody:
    """A person's completed texture on the body; `views` holds its four canonical renders."""

    canonical: CanonicalViews

    def inpaint(self, image: Tensor, mask: Tensor, prompt: str = "", seed: int = 0) -> Tensor:
        """Role "inpaint": masked pixels of the canonical front view get the texture's colour.

        Args:
            image: [3,H,W] in [0,1], the canonical front view where it was observed.
            mask: [1,H,W], 1 = fill.
            prompt: not used; the surface is all that is asked.
            seed: not used; nothing is drawn.

        Raises:
            ValueError: for another size than that of the canonical views.
        """
        front = self._colours()[0]
        if image.shape != front.shape or mask.shape != (1, *front.shape[1:]):
            raise ValueError(
                f"expected image {tuple(front.shape)} and mask of the canonical views' size, got {tuple(image.shape)} "
                f"and {tuple(mask.shape)}; render them with the same camera"
            )
        return image * (1 - mask) + front.to(image) * mask

    def views(self, image: Tensor, mask: Tensor) -> tuple[Tensor, tuple[float, ...]]:
        """Role "views": the person from four sides over grey 0.5, [4,3,H,W] in [0,1], and their azimuths in degrees.

        Args:
            image: [3,H,W] the completed front view; not used: the sides come from the texture.
            mask: [1,H,W] its silhouette; likewise.
        """
        return self._colours(), AZIMUTHS

    def _colours(self) -> Tensor:
        rgba = torch.from_numpy(self.canonical.views).float().permute(0, 3, 1, 2) / 255
        return rgba[:, :3] * rgba[:, 3:] + 0.5 * (1 - rgba[:, 3:])
