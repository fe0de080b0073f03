"""True pictures of a capture, at the size that is scored, by protocol."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import torch
from torch import Tensor

from ahoy_core.captures.capture import Capture, Moment, TruePicture, View
from ahoy_core.captures.surface import TrueSurface
from ahoy_core.conventions import GREY, Cameras
from ahoy_core.metrics.score import Truth
from tasks.evaluation.fitted import Fitted
from tasks.evaluation.withhold import withheld

MOST_INPUT_VIEWS = 8  # of a capture's input frames: neighbours say the same
_MOMENT: dict[str, Moment] = {
    "novel-view-gt": "view",
    "novel-pose-gt": "pose",
    "novel-view-est": "view",
    "input-camera-gt": "view",
    "held-out-frame": "input",
    "input-view": "input",
}


@dataclass(frozen=True)
class Shot:
    """One picture to be made: which view under which protocol, before which camera."""

    protocol: str
    view: View
    camera: Cameras
    truth: Truth


class Truths:
    """What a capture can be scored against.

    Args:
        capture: whose truth.
        fitted: what perception found in the input.
        size: longest side in pixels.
        every: how many frames apart those are that were withheld; None where none were.
    """

    def __init__(self, capture: Capture, fitted: Fitted | None, size: int, every: int | None) -> None:
        self.capture, self.fitted, self.size, self._every = capture, fitted, size, every

    @cached_property
    def surface(self) -> TrueSurface | None:
        """The true body; None where a capture has none."""
        return TrueSurface(self.capture) if "view" in self.capture.bodies else None

    def views(self, protocol: str) -> tuple[list[View], str]:
        """Views of a protocol, and why there are none."""
        capture = self.capture
        found = list(capture.of(_MOMENT[protocol]))
        others = [view for view in found if view.camera != capture.input_camera]
        if protocol in ("novel-view-gt", "novel-pose-gt"):
            return others, "no true pictures of other cameras and of that motion"
        if protocol == "input-camera-gt":
            mine = [view for view in found if view.camera == capture.input_camera]
            return mine, "no true pictures of the whole person before the input's camera"
        if self.fitted is None:
            return [], "no body was fitted to the input"
        if protocol == "novel-view-est":
            mine = [view for view in others if self.fitted.row(view.frame) is not None]
            return mine, "no true picture of another camera at a fitted frame"
        return self._input_views(protocol, found)

    def _input_views(self, protocol: str, found: list[View]) -> tuple[list[View], str]:
        assert self.fitted is not None
        hidden = withheld(self.fitted.used, self._every) if self._every else []
        numbers = [int(self.fitted.index[row]) for row in hidden]
        if protocol == "held-out-frame":
            return [View("input", self.capture.input_camera, n) for n in numbers], "no frames were withheld"
        if not found:
            rows = [row for row in np.flatnonzero(self.fitted.used) if row not in set(hidden)]
            found = [View("input", self.capture.input_camera, int(self.fitted.index[row])) for row in rows]
        learned = [view for view in found if view.frame not in numbers and self.fitted.row(view.frame) is not None]
        return learned[:: -(-len(learned) // MOST_INPUT_VIEWS) or 1], "no fitted frame of the input"

    def shot(self, protocol: str, view: View) -> Shot | None:
        """A picture to be made; None where the truth shows nobody."""
        if view.moment == "input":
            picture, camera = self._input(view), self._fitted_camera()
        else:
            picture, camera = self.capture.picture(view), self.capture.cameras[view.camera]
        picture = reduced(picture, self.size)
        camera = _scaled(camera, *picture.alpha.shape)
        if int((picture.alpha > 0.5).sum()) == 0:
            return None
        if view.moment == "input" or self.surface is None:
            return Shot(protocol, view, camera, Truth(picture.rgb, picture.alpha, picture.known, None, None))
        facts = self.surface.look(view.moment, view.frame, camera)
        return Shot(
            protocol, view, camera, Truth(picture.rgb, picture.alpha, picture.known, facts.observed, facts.head)
        )

    def _input(self, view: View) -> TruePicture:
        if self.capture.of("input"):
            return self.capture.picture(view)
        assert self.fitted is not None
        return self.fitted.picture(view.frame)

    def _fitted_camera(self) -> Cameras:
        assert self.fitted is not None
        return self.fitted.camera


def reduced(picture: TruePicture, size: int) -> TruePicture:
    """The picture with its longest side at most `size` pixels, by an area filter of premultiplied colour."""
    height, width = picture.alpha.shape
    if max(height, width) <= size:
        return picture
    tall, wide = _reduced_size(height, width, size)

    def smaller(values: Tensor) -> Tensor:
        array = np.ascontiguousarray(values.permute(1, 2, 0).numpy())
        small = cv2.resize(array, (wide, tall), interpolation=cv2.INTER_AREA)
        return torch.from_numpy(small.reshape(tall, wide, -1)).permute(2, 0, 1)

    # OpenCV's area filter takes at most four channels.
    small = smaller(torch.cat([picture.rgb * picture.alpha, picture.alpha[None]]))
    known = smaller(picture.known[None].float())[0]
    alpha = small[3]
    rgb = torch.where(alpha > 0, small[:3] / alpha.clamp(min=1e-6), torch.full_like(small[:3], GREY)).clamp(0, 1)
    return TruePicture(rgb, alpha, known > 0.999)  # a pixel that is known in part is not


def _reduced_size(height: int, width: int, size: int) -> tuple[int, int]:
    factor = min(1.0, size / max(height, width))
    return max(1, round(height * factor)), max(1, round(width * factor))


def _scaled(camera: Cameras, height: int, width: int) -> Cameras:
    """The camera for a picture of another size."""
    scale = torch.tensor([width / camera.width, height / camera.height, 1.0])
    return Cameras(camera.viewmats, camera.Ks * scale[:, None], width, height, camera.camera_model)
