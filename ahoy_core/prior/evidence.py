"""What a video showed of one subject, as the fine-tuning reads it: person images, holes closed, sides exchanged."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor

SEEN: Final = 0.5
"""Share of a pixel or latent that must be the visible subject for it to count."""
_SURE: Final = 0.9  # share from which a pixel's colour is the subject's alone: at edges it is mixed with what is behind
_REST_X, _NORMAL_X = 1, 4  # channels of `body_maps` that change sign in a mirror


@dataclass(frozen=True)
class Frames:
    """An unordered set of person images of one subject.

    Attributes:
        images: [N,3,H,W] in [0,1] over grey.
        visible: [N,1,H,W] in [0,1] the visible part of the subject; everything else is kept out of the loss.
        body: [N,7,H/4,W/4] `body_maps` of the fitted body in the same framing, or None.
        azimuth: [N] radians, with `body`.
    """

    images: Tensor
    visible: Tensor
    body: Tensor | None = None
    azimuth: Tensor | None = None

    def __post_init__(self) -> None:
        if self.images.ndim != 4 or self.visible.shape != (len(self.images), 1, *self.images.shape[2:]):
            raise ValueError(
                f"expected images [N,3,H,W] and visible [N,1,H,W], got {tuple(self.images.shape)} and "
                f"{tuple(self.visible.shape)}"
            )
        if len(self.images) == 0 or not bool((self.visible > SEEN).any()):
            raise ValueError("expected at least one frame with a visible subject, got none; skip the identity stage")


def holes_closed(frames: Frames) -> Frames:
    """The same with the nearest visible colour where something hides the body, instead of grey.

    Such pixels count no more than before, but latents are made of whole neighbourhoods: at the edge of an occluder
    they would teach a grey seam. Without body maps nobody knows where the body is hidden, and nothing changes.
    """
    if frames.body is None:
        return frames
    cell = frames.images.shape[-1] // frames.body.shape[-1]
    body = frames.body[:, 0].repeat_interleave(cell, -1).repeat_interleave(cell, -2) > SEEN
    hidden = body & (frames.visible[:, 0] <= SEEN)
    images = frames.images.clone()
    for image, sure, hole in zip(images, frames.visible[:, 0] > _SURE, hidden, strict=True):
        if bool(sure.any()) and bool(hole.any()):
            found = distance_transform_edt(~sure.numpy(), return_distances=False, return_indices=True)
            rows, columns = torch.from_numpy(found).long()
            image[:, hole] = image[:, rows[hole], columns[hole]]
    return replace(frames, images=images)


def with_mirrored(frames: Frames) -> Frames:
    """The N frames, then each of them in a mirror.

    People are nearly symmetric: a side that is always hidden is better learned from the other one than not at all.
    """
    body, azimuth = frames.body, frames.azimuth
    if body is not None and azimuth is not None:
        other = body.flip(-1).clone()
        other[:, [_REST_X, _NORMAL_X]] *= -1
        body, azimuth = torch.cat([body, other]), torch.cat([azimuth, -azimuth])
    return Frames(
        torch.cat([frames.images, frames.images.flip(-1)]),
        torch.cat([frames.visible, frames.visible.flip(-1)]),
        body,
        azimuth,
    )
