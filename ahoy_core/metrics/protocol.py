"""Metric protocols by name: rows of different protocol ids are never put into one table (docs/metrics.md)."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import version
from types import MappingProxyType
from typing import Literal

from pydantic import BaseModel, ConfigDict
from torch import Tensor

from ahoy_core.conventions import GREY
from ahoy_core.metrics.regions import mask_box

Pixels = Literal["whole person", "visible part"]


class Protocol(BaseModel):
    """How a number was measured.

    Attributes:
        name: What is compared, in short.
        region: Which pixels count.
        background: Grey level behind both images.
        poses: Where the body's parameters come from.
        pixels: What of the person is compared; "visible part": both pictures are cut out by the mask of what is seen.
        perceptual: Name of the perceptual net, with the range of its input; empty where there is none.
        input: What the method was given beside the video; empty where that is the video alone.
    """

    model_config = ConfigDict(frozen=True)

    name: str
    region: str
    background: float
    poses: str
    pixels: Pixels = "visible part"
    perceptual: str = ""
    input: str = ""

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
            *((f"perceptual={self.perceptual}",) if self.perceptual else ()),
            *((f"input={self.input}",) if self.input else ()),
        )
        return "/".join(parts)


INPUT_VIEW = Protocol(name="input-view", region="box-of-visible-mask", background=GREY, poses="fitted")
"""A held-out frame of the input, driven by its fitted pose: only the visible part can be compared."""


def _gt(name: str) -> Protocol:
    return Protocol(name=name, region="box", background=GREY, poses="true", pixels="whole person")


PROTOCOLS: Mapping[str, Protocol] = MappingProxyType(
    {
        protocol.name: protocol
        for protocol in (
            _gt("novel-view-gt"),
            _gt("novel-pose-gt"),
            _gt("input-camera-gt"),
            Protocol(
                name="novel-view-est",
                region="box",
                background=GREY,
                poses="fitted, one similarity per capture from joints",
                pixels="whole person",
            ),
            Protocol(name="held-out-frame", region="box", background=GREY, poses="fitted, frame withheld"),
            Protocol(name="input-view", region="box", background=GREY, poses="fitted"),
        )
    }
)
"""The protocols that `ahoy evaluate` knows; docs/metrics.md says what each is for."""


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
