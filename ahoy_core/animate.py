"""Pictures of an avatar: a turntable, a motion, a contact sheet."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ahoy_core.avatar.avatar import Avatar, Posed
from ahoy_core.avatar.render import render
from ahoy_core.body.canonical import canonical_pose
from ahoy_core.body.model import BodyModel
from ahoy_core.conventions import GREY, PERSON_HEIGHT_SHARE, Cameras, turntable_cameras
from ahoy_core.motion import Motion

Frames = NDArray[np.uint8]
Progress = Callable[[int, int], None]

FOV = math.radians(30)
"""Vertical field of view of the cameras here: that of a portrait lens, with little perspective."""
ELEVATION = math.radians(8)
SHEET_VIEWS = 8
# Cameras per call of the rasterizer: bounds its memory at any length of the clip.
_CHUNK = 8


def to_uint8(images: Tensor) -> Frames:
    """Images [C,3,H,W] in [0,1] as uint8 [C,H,W,3]; what is outside the range is clipped."""
    return (images.clamp(0, 1) * 255).round().to(torch.uint8).permute(0, 2, 3, 1).contiguous().numpy()


def framing_cameras(points: Tensor, n: int, height: int, width: int) -> Cameras:
    """`n` cameras round the points, that all have them within 90% of the image.

    Args:
        points: [M,3] metres, world.
        n: Number of cameras, evenly spaced, the first in front.
        height: Pixels.
        width: Pixels.
    """
    low, high = points.amin(0), points.amax(0)
    center = (low + high) / 2
    focal = height / (2 * math.tan(FOV / 2))
    # The nearest point may stand this much in front of the axis: its distance counts.
    reach = float((points - center)[:, :2].norm(dim=1).max())
    tall, wide = float(high[2] - low[2]) / 2 + reach * math.sin(ELEVATION), reach
    needed = max(tall * focal / (height / 2), wide * focal / (width / 2)) / PERSON_HEIGHT_SHARE
    return turntable_cameras(center, needed + reach, n, ELEVATION, height, width, focal)


@torch.no_grad()
def render_views(posed: Posed, cameras: Cameras) -> Frames:
    """One pose from many cameras: uint8 [C,H,W,3] over grey."""
    pictures = []
    for start in range(0, len(cameras), _CHUNK):
        chunk = cameras[list(range(start, min(start + _CHUNK, len(cameras))))]
        images = render(posed.means, posed.covars, posed.opacities, posed.colors, chunk, GREY).images
        pictures.append(to_uint8(images))
    return np.concatenate(pictures)


def turntable(avatar: Avatar, body: BodyModel, frames: int, height: int, width: int) -> Frames:
    """The avatar in the canonical pose from `frames` cameras round it, the first in front: uint8 [frames,H,W,3]."""
    posed = avatar.pose(body, canonical_pose(body))
    return render_views(posed, framing_cameras(_solid(posed), frames, height, width))


def contact_sheet(frames: Frames, views: int = SHEET_VIEWS, columns: int = 4) -> Frames:
    """Evenly chosen frames [T,H,W,3] side by side: uint8 [rows*H, columns*W, 3].

    Raises:
        ValueError: If there are no frames.
    """
    if len(frames) == 0:
        raise ValueError("expected at least one frame, got none; render the turntable first")
    chosen = frames[[index * len(frames) // views for index in range(views)]]
    height, width = chosen.shape[1:3]
    rows = math.ceil(views / columns)
    sheet = np.full((rows * columns, height, width, 3), round(GREY * 255), dtype=np.uint8)
    sheet[:views] = chosen
    return sheet.reshape(rows, columns, height, width, 3).swapaxes(1, 2).reshape(rows * height, columns * width, 3)


@torch.no_grad()
def motion_frames(
    avatar: Avatar, body: BodyModel, motion: Motion, height: int, width: int, progress: Progress | None = None
) -> Iterator[NDArray[np.uint8]]:
    """The avatar in a motion before one still camera that holds all of it.

    Args:
        avatar: Who moves.
        body: Its body model.
        motion: T poses.
        height: Pixels.
        width: Pixels.
        progress: Called with (frame, T) after every frame.

    Yields:
        uint8 [H,W,3], one a frame.
    """
    # Every eighth pose and the last tell where the motion goes; the margin of the framing holds the rest.
    chosen = [*range(0, len(motion), 8), len(motion) - 1]
    sparse = [avatar.pose(body, motion.pose[i], motion.transl[i]) for i in chosen]
    cameras = framing_cameras(torch.cat([_solid(posed) for posed in sparse]), 1, height, width)
    for number in range(len(motion)):
        yield render_views(avatar.pose(body, motion.pose[number], motion.transl[number]), cameras)[0]
        if progress is not None:
            progress(number + 1, len(motion))


def _solid(posed: Posed) -> Tensor:
    """Means of the Gaussians that can be seen."""
    return posed.means[posed.opacities > 0.05]
