"""Cameras that frame bodies as person images: at 90% of the height, or of the width where that decides."""

from __future__ import annotations

from typing import Final

import torch
from torch import Tensor

from ahoy_core.conventions import PERSON_HEIGHT_SHARE, CameraModel, Cameras, look_at, orbit_eyes

HEIGHT: Final = 128
WIDTH: Final = 64
"""Pixels of the embedded prior's person images."""
DISTANCE: Final = 4.0  # metres between camera and person where nothing else is asked for
_SPARSE: Final = 7  # every so many vertices give the box of a body to a millimetre


def framing_Ks(  # noqa: N802
    viewmats: Tensor,
    vertices: Tensor,
    height: int = HEIGHT,
    width: int = WIDTH,
    camera_model: CameraModel = "pinhole",
    share: float = PERSON_HEIGHT_SHARE,
    together: bool = True,
) -> Tensor:
    """Intrinsics [T,3,3] that bring the bodies' box to the middle of the picture.

    Args:
        viewmats: [T,4,4] world -> camera.
        vertices: [T,V,3] of the bare body in each frame, world, metres.
        height: pixels.
        width: pixels.
        camera_model: "pinhole" or "ortho".
        share: of the height (or width, where that is tighter) that the box fills.
        together: one framing for all frames; else each frame has its own.

    Raises:
        ValueError: when a body stands behind a pinhole camera or has no extent.
    """
    unit = torch.eye(3).expand(len(viewmats), 3, 3).contiguous()
    flat = Cameras(viewmats, unit, width, height, camera_model).project(vertices[:, ::_SPARSE])
    if camera_model == "pinhole" and not bool((flat.depths > 0).all()):
        raise ValueError("expected bodies in front of the camera, got some behind it; re-centre the motion's root")
    low, high = flat.pixels.amin(1), flat.pixels.amax(1)
    if together:
        low, high = low.amin(0).expand_as(low), high.amax(0).expand_as(high)
    extent = high - low
    if not bool((extent > 0).all()):
        raise ValueError("expected bodies with an extent, got points; check the pose")
    scale = share * torch.minimum(height / extent[:, 1], width / extent[:, 0])
    Ks = torch.zeros(len(viewmats), 3, 3)
    Ks[:, 0, 0] = Ks[:, 1, 1] = scale
    Ks[:, :2, 2] = torch.tensor([width / 2, height / 2]) - scale[:, None] * 0.5 * (low + high)
    Ks[:, 2, 2] = 1
    return Ks


def orbit_cameras(
    vertices: Tensor, azimuths: Tensor, elevation: float = 0.0, distance: float = DISTANCE, ortho: bool = False
) -> Cameras:
    """Cameras round bodies that face -y, one a frame, all with the same framing.

    Args:
        vertices: [T,V,3] of the bare body, world, metres.
        azimuths: [T] radians; 0 in front, pi/2 on the person's left.
        elevation: radians.
        distance: metres from the middle of all frames.
        ortho: orthographic cameras.
    """
    center = 0.5 * (vertices.amin((0, 1)) + vertices.amax((0, 1)))
    viewmats = look_at(orbit_eyes(center, distance, azimuths, elevation), center)
    model: CameraModel = "ortho" if ortho else "pinhole"
    return Cameras(viewmats, framing_Ks(viewmats, vertices, camera_model=model), WIDTH, HEIGHT, model)
