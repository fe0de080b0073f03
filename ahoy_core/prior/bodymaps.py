"""What the prior is told of the body: silhouette, where on the body, which way it faces, and the azimuth."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import torch
from torch import Tensor

from ahoy_core.body.model import BodyModel
from ahoy_core.conventions import Cameras
from ahoy_core.prior.raster import rasterize

CHANNELS: Final = 7
"""Silhouette; place on the body (x, y, z of the average adult at rest, each in [-1,1]); normal in camera axes."""
CELL: Final = 4  # pixels of the person image a cell of the maps


def body_maps(body: BodyModel, vertices: Tensor, cameras: Cameras) -> Tensor:
    """Maps of posed bodies, one camera a frame.

    Args:
        body: that the vertices are of; the embedded prior knows the packaged one alone.
        vertices: [T,V,3] posed, world, metres.
        cameras: T cameras with the person image's size, a multiple of `CELL`.

    Returns:
        [T,7,H/4,W/4] float32: silhouette in [0,1]; the rest in [-1,1], 0 where the body is not (means over the cell).

    Raises:
        ValueError: when there are not as many cameras as bodies, or the size is no multiple of `CELL`.
    """
    if len(cameras) != len(vertices) or cameras.height % CELL or cameras.width % CELL:
        size = f"{cameras.width}x{cameras.height}"
        raise ValueError(
            f"expected one camera a frame and sizes divisible by {CELL}, got {len(cameras)} cameras of {size} for "
            f"{len(vertices)} frames"
        )
    faces = body.faces.numpy().astype(np.int32)
    place = _places(body)
    projected = cameras.project(vertices)
    screen = torch.cat([projected.pixels, projected.depths[..., None]], -1).numpy().astype(np.float32)
    maps = np.zeros((len(vertices), CHANNELS, cameras.height, cameras.width), dtype=np.float32)
    for t in range(len(vertices)):
        hits = rasterize(screen[t], faces, cameras.height, cameras.width)
        index = np.flatnonzero(hits.face >= 0)
        corners = faces[hits.face.ravel()[index]]
        bary = hits.bary.reshape(-1, 2)[index]
        weights = np.concatenate([1 - bary.sum(1, keepdims=True), bary], 1)[..., None]
        turned = (vertices[t] @ cameras.viewmats[t, :3, :3].T).numpy()[corners]
        normal = np.cross(turned[:, 1] - turned[:, 0], turned[:, 2] - turned[:, 0])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        values = np.concatenate([np.ones((len(index), 1)), (place[corners] * weights).sum(1), normal], 1)
        maps[t].reshape(CHANNELS, -1)[:, index] = values.T
    return torch.nn.functional.avg_pool2d(torch.from_numpy(maps), CELL)


def camera_azimuth(viewmats: Tensor, root_rotations: Tensor) -> Tensor:
    """Azimuth [T] in radians of each camera about the person: 0 in front, pi/2 on the person's left.

    Args:
        viewmats: [T,4,4] world -> camera.
        root_rotations: [T,3,3] of the body's root in the world.
    """
    backward = -viewmats[:, 2, :3]  # from what is looked at towards the camera
    own = (root_rotations.transpose(1, 2) @ backward[..., None])[..., 0]
    return torch.atan2(own[:, 0], -own[:, 1]) % (2 * math.pi)


def _places(body: BodyModel) -> np.ndarray:
    """[V,3]: the average adult's vertices at rest, scaled to [-1,1] along each axis."""
    still = torch.zeros(1, body.n_joints, 3)
    rest = body(still, body.default_betas[None], still[:, 0]).vertices[0]
    low, high = rest.amin(0), rest.amax(0)
    return (2 * (rest - low) / (high - low) - 1).numpy()
