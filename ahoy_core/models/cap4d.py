"""Role "face" by CAP4D, as an external command: pictures of the head, expressions and cameras in, pictures out.

`in/references/000.png` ... are square crops of the head, `in/cameras.json` the wanted cameras in the head's frame
(metres, OpenCV), `in/expressions.npy` [P,E] with `in/expression_names.json`. The command leaves `out/000.png` ..., one
a camera.
"""

from __future__ import annotations

import json

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict
from torch import Tensor
from torch.nn.functional import interpolate

from ahoy_core.conventions import GREY, Cameras
from ahoy_core.models.adapter import Adapter, Fill
from ahoy_core.models.external import ExternalModel, exchange, read_pictures, run_command, write_cameras, write_picture


class Cap4dOptions(BaseModel):
    """Knobs.

    Attributes:
        file: names of the command's pictures, `{}` is the number.
        expression_names: what the columns of `expressions.npy` are, for the command.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    file: str = "{:03d}.png"
    expression_names: tuple[str, ...] = ()


class Cap4d(ExternalModel[Cap4dOptions]):
    """CAP4D as the role "face"."""

    name = "CAP4D"

    def __call__(self, references: Tensor, expressions: Tensor, cameras: Cameras, seed: int = 0) -> Tensor:
        """Pictures of the head from P cameras over grey 0.5.

        Args:
            references: [R,3,S,S] in [0,1], at least one.
            expressions: [P,E].
            cameras: P cameras in the canonical head frame.
            seed: put into the command's words as `{seed}`.

        Returns:
            [P,3,height,width] in [0,1], of the cameras' size.

        Raises:
            ValueError: no reference, or another number of expressions than cameras.
            CommandError: the command fails, or leaves other pictures than it should.
        """
        if len(references) == 0 or len(expressions) != len(cameras):
            raise ValueError(
                f"expected at least one reference and an expression a camera, got {len(references)} references, "
                f"{len(expressions)} expressions and {len(cameras)} cameras"
            )
        size = cameras.height, cameras.width
        if len(cameras) == 0:
            return torch.zeros(0, 3, *size)
        with exchange("cap4d") as (given, made):
            for number, picture in enumerate(references):
                write_picture(given / "references" / f"{number:03d}.png", picture)
            write_cameras(given / "cameras.json", cameras)
            np.save(given / "expressions.npy", expressions.float().numpy())
            (given / "expression_names.json").write_text(json.dumps(self.options.expression_names), encoding="utf-8")
            run_command(self.fill, self.adapter, given, made, {"seed": str(seed)})
            names = [self.options.file.format(number) for number in range(len(cameras))]
            pictures = read_pictures(made, names, self.adapter)
        return torch.stack([_over_grey(picture, size) for picture in pictures])


def _over_grey(picture: Tensor, size: tuple[int, int]) -> Tensor:
    image = picture[:3] * picture[3:] + GREY * (1 - picture[3:]) if len(picture) == 4 else picture
    return interpolate(image[None], size, mode="bilinear", antialias=True, align_corners=False)[0].clamp(0, 1)


def load_cap4d(fill: Fill, adapter: Adapter) -> Cap4d:
    """CAP4D by its command; `options`: `Cap4dOptions`."""
    return Cap4d(fill, adapter, Cap4dOptions(**fill.options))
