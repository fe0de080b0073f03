"""Role "views" by SyncHuman, as an external command: one RGBA picture in, five views out, four of them ours.

The command's `in/image.png` is the canonical front view with straight alpha, square. It leaves `out/color_0.png` ... in
the model's own order (`SyncHumanOptions.order`): front, the person's right, back, the person's left, face.
"""

from __future__ import annotations

from typing import Final, Literal

import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor
from torch.nn.functional import interpolate, pad

from ahoy_core.conventions import GREY
from ahoy_core.models.adapter import Adapter, Fill
from ahoy_core.models.boxes import mask_bounds
from ahoy_core.models.errors import CommandError
from ahoy_core.models.external import ExternalModel, exchange, read_pictures, run_command, write_picture

SIDES: Final = {"front": 0.0, "left": 90.0, "back": 180.0, "right": 270.0}
"""Our azimuths in degrees, by which side of the person is seen."""
_EDGE: Final = 0.08  # distance in colour from the background at which a pixel counts as person


class SyncHumanOptions(BaseModel):
    """Knobs.

    Attributes:
        order: what the command's pictures show, by number; "face" is left out.
        file: their names, `{}` is the number.
        side: pixels of the square picture that the command gets.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    order: tuple[Literal["front", "left", "back", "right", "face"], ...] = ("front", "right", "back", "left", "face")
    file: str = "color_{}.png"
    side: int = Field(default=768, ge=16)


class SyncHuman(ExternalModel[SyncHumanOptions]):
    """SyncHuman as the role "views"."""

    name = "SyncHuman"

    def __call__(self, image: Tensor, mask: Tensor) -> tuple[Tensor, tuple[float, ...]]:
        """The person from four sides over grey 0.5.

        What the model returns is scaled and moved as one, so that its front view meets the given silhouette: the four
        cameras are orthographic and share their vertical axis.

        Args:
            image: [3,H,W] canonical front view.
            mask: [1,H,W] its silhouette, not empty.

        Returns:
            [4,3,H,W] in [0,1] and azimuths 0, 90, 180, 270.

        Raises:
            CommandError: the command fails, or leaves other pictures than it should.
        """
        if float(mask_bounds(mask[0])[2]) == 0:
            raise ValueError("expected a silhouette with something in it, got an empty mask")
        names = {side: self.options.file.format(self.options.order.index(side)) for side in SIDES}
        with exchange("synchuman") as (given, made):
            square, alpha = (_square(x, self.options.side) for x in (image * mask, mask))
            write_picture(given / "image.png", square / alpha.clamp(min=1e-3), alpha)
            run_command(self.fill, self.adapter, given, made)
            pictures = read_pictures(made, list(names.values()), self.adapter)
        return self._placed([_with_alpha(p) for p in pictures], mask), tuple(SIDES.values())

    def _placed(self, pictures: list[Tensor], mask: Tensor) -> Tensor:
        """Pictures [4,h,w] (colour, alpha) at the scale and place of the silhouette: [4,3,H,W] over grey."""
        _, top, _, bottom = mask_bounds(mask[0]).tolist()
        own = mask_bounds(pictures[0][3])
        if float(own[3]) == 0:
            raise CommandError(f"{self.adapter.label}: the command's front view shows nobody")
        scale = (bottom - top) / float(own[3] - own[1])
        height, width = mask.shape[1:]
        views = []
        for picture in pictures:
            x0, _, x1, _ = mask_bounds(picture[3]).tolist()
            size = max(1, round(picture.shape[1] * scale)), max(1, round(picture.shape[2] * scale))
            premultiplied = torch.cat([picture[:3] * picture[3:], picture[3:]])[None]
            sized = interpolate(premultiplied, size, mode="bilinear", antialias=True, align_corners=False)[0]
            up = round(top - float(own[1]) * scale)
            left = round((width - (x0 + x1) * scale) / 2)
            placed = pad(sized, (left, width - left - size[1], up, height - up - size[0])).clamp(0, 1)
            views.append(placed[:3] + GREY * (1 - placed[3:]))
        return torch.stack(views)


def _square(image: Tensor, side: int) -> Tensor:
    """[C,H,W] in the middle of a square, zeros beside it, [C,side,side]."""
    _, height, width = image.shape
    longest = max(height, width)
    left, top = (longest - width) // 2, (longest - height) // 2
    whole = pad(image, (left, longest - width - left, top, longest - height - top))
    return interpolate(whole[None].float(), (side, side), mode="bilinear", antialias=True, align_corners=False)[0]


def _with_alpha(picture: Tensor) -> Tensor:
    """[4,h,w]: the picture's own alpha, or what differs from its even background."""
    if len(picture) == 4:
        return picture
    corners = torch.stack([picture[:, y, x] for y in (0, -1) for x in (0, -1)])
    away = (picture - corners.median(0).values[:, None, None]).abs().amax(0, keepdim=True)
    return torch.cat([picture, (away > _EDGE).float()])


def load_synchuman(fill: Fill, adapter: Adapter) -> SyncHuman:
    """SyncHuman by its command; `options`: `SyncHumanOptions`."""
    return SyncHuman(fill, adapter, SyncHumanOptions(**fill.options))
