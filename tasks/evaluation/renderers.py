"""Who makes the pictures that are scored."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import torch
from torch import Tensor

from ahoy_core.avatar.avatar import Avatar
from ahoy_core.avatar.render import render
from ahoy_core.body.model import BodyModel
from ahoy_core.captures.capture import Capture, drive
from ahoy_core.metrics.alignment import Similarity
from ahoy_core.metrics.score import REFERENCES, Made, flat, shifted
from tasks.evaluation.fitted import Fitted
from tasks.evaluation.truths import Shot

Renderer = Callable[[Shot], Made | None]
"""Makes a picture; None where it has none for this shot."""


class Driver:
    """Poses for a body of its own shape, as the protocols say.

    Args:
        body: the model.
        betas: [S] the shape that was fitted.
        capture: whose true bodies drive it.
        fitted: what drives it where poses are estimated.
    """

    def __init__(self, body: BodyModel, betas: Tensor, capture: Capture, fitted: Fitted | None) -> None:
        self.betas = betas
        self._body, self._capture, self._fitted = body, capture, fitted
        self._driven = {moment: drive(truth, body, betas) for moment, truth in capture.bodies.items()}

    def pose(self, shot: Shot) -> tuple[Tensor, Tensor]:
        """Pose [J,3] and place [3] of a shot.

        Raises:
            ValueError: the frame has no fitted pose, and the protocol asks for one.
        """
        view = shot.view
        if shot.protocol in ("novel-view-gt", "novel-pose-gt", "input-camera-gt"):
            poses, places = self._driven[view.moment]
            row = self._capture.bodies[view.moment].row(view.frame)
            return poses[row], places[row]
        assert self._fitted is not None
        fitted_row = self._fitted.row(view.frame)
        if fitted_row is None:
            raise ValueError(f"expected a fitted pose in frame {view.frame}, got none; leave the frame out")
        return self._fitted.pose[fitted_row], self._fitted.transl[fitted_row]

    @cached_property
    def alignment(self) -> Similarity:
        """The similarity of `novel-view-est`."""
        assert self._fitted is not None
        return self._fitted.alignment(self._capture.bodies["view"], self._body)


class AvatarRenderer:
    """An avatar, driven as the protocol says.

    Args:
        avatar: who.
        body: the model that it stands on.
        capture: whose true bodies drive it.
        fitted: what drives it where poses are estimated.
    """

    def __init__(self, avatar: Avatar, body: BodyModel, capture: Capture, fitted: Fitted | None) -> None:
        self._avatar, self._body = avatar, body
        self._driver = Driver(body, avatar.betas, capture, fitted)

    @torch.no_grad()
    def __call__(self, shot: Shot) -> Made:
        """Render one shot over grey."""
        pose, transl = self._pose(shot)
        posed = self._avatar.pose(self._body, pose, transl)
        means, covars = posed.means, posed.covars
        if shot.protocol == "novel-view-est":
            means, covars = self._driver.alignment.points(means), self._driver.alignment.covariances(covars)
        image, alpha = render(means, covars, posed.opacities, posed.colors, shot.camera)
        return Made(image[0].clamp(0, 1), alpha[0, 0].clamp(0, 1))

    def _pose(self, shot: Shot) -> tuple[Tensor, Tensor]:
        return self._driver.pose(shot)


def reference(name: str) -> Renderer:
    """The renderer of a reference row.

    Raises:
        ValueError: no such reference.
    """
    if name not in REFERENCES:
        raise ValueError(f"expected a reference among {list(REFERENCES)}, got {name!r}")
    make = flat if "flat" in name else shifted
    return lambda shot: make(shot.truth)
