"""Metric protocols: rows of different protocol ids are never put into one table."""

from __future__ import annotations

from importlib.metadata import version

from pydantic import BaseModel, ConfigDict
from torch import Tensor

from ahoy_core.conventions import GREY
from ahoy_core.metrics.regions import mask_box


class Protocol(BaseModel):
    """How a number was measured.

    Attributes:
        name: What is compared, in short.
        region: Which pixels count.
        background: Grey level behind both images.
        poses: Where the body's parameters come from.
    """

    model_config = ConfigDict(frozen=True)

    name: str
    region: str
    background: float
    poses: str

    def id(self, height: int, width: int) -> str:
        """Everything that two comparable rows must share, as one string.

        Args:
            height: Pixels of the compared frames, before cropping.
            width: Likewise.
        """
        parts = (
            self.name,
            f"region={self.region}",
            f"background={self.background:g}",
            f"poses={self.poses}",
            f"size={width}x{height}",
            f"ssim=kornia-{version('kornia')}-11",
            f"torch-{version('torch')}",
        )
        return "/".join(parts)


INPUT_VIEW = Protocol(name="input-view", region="box-of-visible-mask", background=GREY, poses="fitted")
"""A held-out frame of the input, driven by its fitted pose: only the visible part can be compared."""


def input_view_pair(image: Tensor, frame: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
    """Prediction and truth of the protocol `INPUT_VIEW`: both cut out by the visible mask, over grey, in its box.

    Args:
        image: [3,H,W] rendering over grey.
        frame: [3,H,W] the input's frame.
        mask: [H,W] alpha of the visible person, [0,1].

    Raises:
        ValueError: If the mask is empty.
    """
    x0, y0, x1, y1 = mask_box(mask)
    box = (slice(y0, y1), slice(x0, x1))
    alpha = mask[box]
    pair = [(x[:, *box].clamp(0, 1)) * alpha + GREY * (1 - alpha) for x in (image, frame)]
    return pair[0], pair[1]
