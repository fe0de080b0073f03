"""Pictures of an avatar: a turntable, a motion."""

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
from ahoy_core.formats.images import to_uint8
from ahoy_core.motion import Motion

Frames = NDArray[np.uint8]
Progress = Callable[[int, int], None]

FOV = math.radians(30)
"""Vertical field of view of the cameras here: that of a portrait lens, with little perspective."""
ELEVATION = math.radians(8)
SHEET_VIEWS = 8
# Cameras per call of the rasterizer: bounds its memory at any length of the clip.
_CHUNK = 8
# Metres: no camera comes nearer to the middle of what it looks at.
_NEAREST = 0.1


def framing_cameras(points: Tensor, n: int, height: int, width: int) -> Cameras:
    """`n` cameras round the points, as near as they can be with all points within the middle 90% of every picture.

    Args:
        points: [M,3] metres, world.
        n: Number of cameras, evenly spaced, the first in front.
        height: Pixels.
        width: Pixels.
    """
    low, high = points.amin(0), points.amax(0)
    center = (low + high) / 2
    focal = height / (2 * math.tan(FOV / 2))
    around = turntable_cameras(center, 1.0, n, ELEVATION, height, width, focal).viewmats
    # A point x right and z behind the centre is seen at focal * x / (radius + z): every point asks for a radius.
    right, down, behind = ((points - center) @ around[:, :3, :3].transpose(1, 2)).unbind(-1)
    wide, tall = (focal / (PERSON_HEIGHT_SHARE * side / 2) for side in (width, height))
    asked = torch.maximum(right.abs() * wide, down.abs() * tall) - behind
    radius = max(float(asked.max()), float((high - low).norm()), _NEAREST)
    return turntable_cameras(center, radius, n, ELEVATION, height, width, focal)


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


def evenly_chosen(frames: Frames, count: int = SHEET_VIEWS) -> list[Frames]:
    """`count` frames of [T,H,W,3], evenly spread from the first on, for a contact sheet; a short clip repeats some.

    Raises:
        ValueError: If there are no frames.
    """
    if len(frames) == 0:
        raise ValueError("expected at least one frame, got none; render the turntable first")
    return [frames[index * len(frames) // count] for index in range(count)]


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
