"""What the prior is told of the body: silhouette, where on the body, which way it faces, and the azimuth."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final, NamedTuple

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
    place = _places(body)
    maps = np.zeros((len(vertices), CHANNELS, cameras.height, cameras.width), dtype=np.float32)
    for t, shown in enumerate(_shown(body, vertices, cameras)):
        turned = (vertices[t] @ cameras.viewmats[t, :3, :3].T).numpy()[shown.corners]
        normal = np.cross(turned[:, 1] - turned[:, 0], turned[:, 2] - turned[:, 0])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        values = np.concatenate([np.ones((len(normal), 1)), shown.of(place), normal], 1)
        maps[t].reshape(CHANNELS, -1)[:, shown.pixels] = values.T
    return torch.nn.functional.avg_pool2d(torch.from_numpy(maps), CELL)


def light_maps(body: BodyModel, vertices: Tensor, cameras: Cameras, brightness: np.ndarray) -> Tensor:
    """How bright posed bodies are lit, one camera a frame: smooth, and going on beside the body for what is worn on it.

    Args:
        body: that the vertices are of.
        vertices: [T,V,3] posed, world, metres.
        cameras: T cameras, sizes as for `body_maps`.
        brightness: [V] of the vertices, a share of their colours' own (`ahoy_core.prior.light.brightness_on`).

    Returns:
        [T,1,H,W] float32; 1 far from the body.
    """
    size = (cameras.height, cameras.width)
    drawn = np.zeros((len(vertices), 2, *size), dtype=np.float32)
    for t, shown in enumerate(_shown(body, vertices, cameras)):
        lit = shown.of(brightness[:, None])
        drawn[t].reshape(2, -1)[:, shown.pixels] = np.concatenate([np.ones_like(lit), lit], 1).T
    cells = torch.nn.functional.avg_pool2d(torch.from_numpy(drawn), CELL)
    cover, lit = torch.nn.functional.avg_pool2d(cells, 3, stride=1, padding=1).split(1, 1)
    smooth = torch.where(cover > 0, lit / cover.clamp(min=1e-6), torch.ones_like(lit))
    return torch.nn.functional.interpolate(smooth, size, mode="bilinear", align_corners=False)


class _Shown(NamedTuple):
    """Pixels [N] of an image that show the body, and the corners [N,3] of what they show with their weights [N,3]."""

    pixels: np.ndarray
    corners: np.ndarray
    weights: np.ndarray

    def of(self, values: np.ndarray) -> np.ndarray:
        """Values [N,K] of the pixels, of those [V,K] of the vertices."""
        mixed: np.ndarray = (values[self.corners] * self.weights[..., None]).sum(1)
        return mixed


def _shown(body: BodyModel, vertices: Tensor, cameras: Cameras) -> Iterator[_Shown]:
    faces = body.faces.numpy().astype(np.int32)
    projected = cameras.project(vertices)
    screens = torch.cat([projected.pixels, projected.depths[..., None]], -1).numpy().astype(np.float32)
    for screen in screens:
        hits = rasterize(screen, faces, cameras.height, cameras.width)
        pixels = np.flatnonzero(hits.face >= 0)
        bary = hits.bary.reshape(-1, 2)[pixels]
        weights = np.concatenate([1 - bary.sum(1, keepdims=True), bary], 1)
        yield _Shown(pixels, faces[hits.face.ravel()[pixels]], weights)


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
