"""Where the masks end, seen from the fitted body's outline: which edges are certain, and which are another thing's."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from ahoy_core.body.lbs import forward_kinematics
from ahoy_core.body.model import BodyModel
from ahoy_core.perceive.fill import fill_triangles
from ahoy_core.perceive.masks import EDGE, faces_camera, project_points
from ahoy_core.perceive.outline import Outline
from ahoy_core.perceive.reduced import ReducedBody
from ahoy_core.perceive.residuals import person_depth
from ahoy_core.perceive.state import State

PLACES = 64  # most places a frame
SPACING = 0.03  # metres between places, at the person's depth
OUT, IN = 0.08, 0.04  # metres searched outside and inside: an edge far inside is mostly an occluder's
CLEAR = 0.02  # metres beyond an edge over which the mask must not come back
NEIGHBOURHOOD = 0.15  # metres: an edge inside the body counts by the share of places this near that have an edge
STEPS = 24  # samples along a normal
PARALLEL = 0.8  # cosine between the edge's normal and the outline's
SOFTEN = 0.012  # metres of blur under which the outline's normals are taken
LANDMARK_REACH = 0.15  # metres: landmarks this near vouch for a place being in view
UNCOUNTED = ("head", "hands", "feet", "eyes", "interior")  # hair, fingers and shoes are not the body's shape


@dataclass(frozen=True)
class Skin:
    """What stays the same over the frames.

    Attributes:
        faces: [M,3] all triangles.
        counted: [V] bool, vertices whose outline is compared.
        near: [V,33] shares of the landmarks that are near each vertex at rest, rows sum to 1.
    """

    faces: NDArray[np.int64]
    counted: NDArray[np.bool_]
    near: NDArray[np.float64]


def make_skin(body: BodyModel, reduced: ReducedBody) -> Skin:
    """Collect a body's triangles and which vertices count."""
    counted = np.ones(len(reduced.surface), np.bool_)
    for name in UNCOUNTED:
        if name in body.regions:
            counted &= ~body.regions[name].numpy()
    landmarks = reduced.shaped_moments(reduced.base_betas)[..., :3].sum(1)
    near = torch.softmax(-0.5 * torch.cdist(reduced.surface, landmarks).square() / LANDMARK_REACH**2, dim=1)
    return Skin(body.faces.numpy(), counted, near.numpy())


def find_edges(
    reduced: ReducedBody, skin: Skin, state: State, masks: NDArray[np.uint8], visible: torch.Tensor, K: torch.Tensor
) -> Outline:
    """Look for the masks' edges across from the outlines of the bodies.

    Args:
        reduced: the body.
        skin: `make_skin` of it.
        state: N poses and the shape.
        masks: [N,H,W] 0 to 255, the visible person.
        visible: [N,33] in [0,1], of the landmarks: places near hidden ones count less.
        K: [3,3] pixels.
    """
    n = len(masks)
    vertices, weights = np.zeros((n, PLACES), np.int64), np.zeros((n, PLACES))
    targets, normals = np.zeros((n, PLACES, 2)), np.zeros((n, PLACES, 2))
    normals[..., 0] = 1.0
    landmarks, _ = state.posed(reduced)
    focal = float((K[0, 0] * K[1, 1]).sqrt())
    scales = (focal / person_depth(landmarks)).numpy()
    rest = reduced.shaped_surface(state.betas)
    joints = reduced.rest_joints(state.betas)[None]
    transforms = forward_kinematics(state.rotations(), joints, reduced.parents, state.transl(reduced))[:, :, :3]
    for t in range(n):
        if not masks[t].any():
            continue
        blended = (reduced.skin @ transforms[t].flatten(1)).unflatten(1, (3, 4))
        posed = (blended[..., :3] @ rest[..., None])[..., 0] + blended[..., 3]
        points, in_front = project_points(posed.numpy(), K.numpy())
        if not in_front.all():
            continue
        chosen, out, canvas = _rim(points, skin, masks.shape[1:], float(scales[t]))
        edges, certain = _across(points[chosen], out, masks[t], canvas, float(scales[t]))
        k = len(chosen)
        vertices[t, :k], targets[t, :k], normals[t, :k] = chosen, edges, out
        weights[t, :k] = certain * (skin.near[chosen] @ visible[t].numpy())
    return Outline(*(torch.from_numpy(x) for x in (vertices, targets, normals, weights)))


def _rim(
    points: NDArray[np.float64], skin: Skin, size: tuple[int, ...], scale: float
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.uint8]]:
    """Evenly spread vertices [k] on the silhouette's edge, the outward normals [k,2] there, and the silhouette."""
    canvas = np.zeros(size, np.uint8)
    limit = 4.0 * max(size)
    points = np.clip(points, -limit, limit)
    facing = faces_camera(points, skin.faces)
    fill_triangles(canvas, points, skin.faces[facing])
    both = np.zeros((2, len(points)), np.bool_)
    both[0, skin.faces[facing]] = both[1, skin.faces[~facing]] = True
    margin = 2.0
    inside = ((points > margin) & (points < np.array(size[::-1]) - margin)).all(1)
    rim = np.flatnonzero(both.all(0) & skin.counted & inside)
    cell = max(1.0, SPACING * scale)
    key = np.floor(points[rim] / cell).astype(np.int64) @ np.array([1, 1 << 20])
    _, first = np.unique(key, return_index=True)
    rim = rim[first]
    blur = max(1.0, SOFTEN * scale)
    soft = cv2.GaussianBlur(canvas.astype(np.float32) / 255.0, (0, 0), blur)
    slope = np.stack([_sample(cv2.Sobel(soft, -1, x, 1 - x, ksize=3, scale=0.125), points[rim]) for x in (1, 0)], 1)
    steep = np.linalg.norm(slope, axis=1)
    # Across a straight edge the blurred silhouette falls by 0.4 a blur; half of it rules out edges inside of the body.
    kept = np.flatnonzero(steep > 0.2 / blur)
    kept = kept[np.unique(np.linspace(0, len(kept) - 1, min(PLACES, len(kept))).round().astype(int))]
    return rim[kept], -slope[kept] / steep[kept, None], canvas


def _across(
    points: NDArray[np.float64],
    out: NDArray[np.float64],
    mask: NDArray[np.uint8],
    canvas: NDArray[np.uint8],
    scale: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mask edges [k,2] along the normals, and how certain each is, [k] in [0,1]."""
    if len(points) == 0:
        return np.zeros((0, 2)), np.zeros(0)
    away = np.linspace(-(IN + CLEAR), OUT + CLEAR, STEPS) * scale
    line = points[:, None] + away[:, None] * out[:, None]
    values = _sample(mask.astype(np.float32), line) - EDGE
    clear = max(1, round(CLEAR * scale / (away[1] - away[0])))
    person = values >= 0
    falls = person[:, :-1] & ~person[:, 1:]
    falls[:, :clear] = falls[:, len(away) - clear :] = False
    # The nearest fall to the outline: the first outside if the outline is covered, else the last inside.
    order = np.where(falls, np.abs(0.5 * (away[1:] + away[:-1])), np.inf)
    best = order.argmin(1)
    row = np.arange(len(points))
    found = np.isfinite(order[row, best])
    high, low = values[row, best], values[row, best + 1]
    share = high / np.maximum(high - low, 1e-6)
    place = away[best] + share * (away[1] - away[0])
    edges = points + place[:, None] * out
    certain = found & _stays(person, best, clear) & _parallel(mask, edges, out, scale) & _alone(canvas, line, best)
    certain &= ((edges > 1.0) & (edges < np.array(mask.shape[::-1]) - 1.0)).all(1)
    return edges, certain * np.where(place < 0, _undisturbed(points, certain, scale), 1.0)


def _undisturbed(points: NDArray[np.float64], certain: NDArray[np.bool_], scale: float) -> NDArray[np.float64]:
    """Squared share [k] of near places that have a certain edge: beside a thing in front many have none."""
    near = np.linalg.norm(points[:, None] - points[None], axis=-1) < NEIGHBOURHOOD * scale
    return np.asarray(((near & certain).sum(1) / near.sum(1)) ** 2)


def _stays(person: NDArray[np.bool_], best: NDArray[np.int64], clear: int) -> NDArray[np.bool_]:
    """The mask is whole inside of the edge and does not come back outside of it, over `clear` samples."""
    steps = np.arange(1, clear + 1)
    row = np.arange(len(best))[:, None]
    last = person.shape[1] - 1
    inner = person[row, np.clip(best[:, None] - steps + 1, 0, last)].all(1)
    outer = ~person[row, np.clip(best[:, None] + steps, 0, last)].any(1)
    return np.asarray(inner & outer)


def _parallel(
    mask: NDArray[np.uint8], edges: NDArray[np.float64], out: NDArray[np.float64], scale: float
) -> NDArray[np.bool_]:
    """The mask's edge runs along the outline: another thing's edge crosses it, mostly."""
    reach = max(1.0, SOFTEN * scale)
    image = mask.astype(np.float32)
    along = np.stack([-out[:, 1], out[:, 0]], axis=1)
    across, beside = (_sample(image, edges - reach * d) - _sample(image, edges + reach * d) for d in (out, along))
    return np.asarray(across > PARALLEL * np.hypot(across, beside))


def _alone(canvas: NDArray[np.uint8], line: NDArray[np.float64], best: NDArray[np.int64]) -> NDArray[np.bool_]:
    """No other part of the body lies beyond the outline before the edge: the edge might be that part's."""
    body = _sample(canvas.astype(np.float32), line) > 127
    middle = body.shape[1] * (IN + CLEAR) / (OUT + IN + 2 * CLEAR)
    column = np.arange(body.shape[1])
    beyond = (column > middle + 2) & (column <= best[:, None])
    return np.asarray(~(body & beyond).any(1))


def _sample(image: NDArray[Any], points: NDArray[np.floating]) -> NDArray[np.float32]:
    """Bilinear values at pixels [...,2], centres at +0.5; beyond the border its nearest value."""
    where = (points - 0.5).astype(np.float32).reshape(1, -1, 2)
    values = cv2.remap(image, where[..., 0], where[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(values, dtype=np.float32).reshape(points.shape[:-1])
