"""Two masks per frame: what is visible of the person (paper section 3.1: M_t), and the fitted body's silhouette."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ahoy_core.perceive.fill import fill_triangles
from ahoy_core.perceive.guided import guided_filter

CELLS = 256  # across the network's mask
GUIDE_CELLS = 2  # how far an edge may move to meet an edge of the picture: the mask knows no better than this
GUIDE_EPS = 1e-3  # colour variance (RGB in [0,1]) below which a patch counts as flat
SOFT_LOW, SOFT_HIGH = 0.2, 0.85  # mask values that become 0 and 1: the network's edge is wider than the picture's
EDGE = 0.5 * (SOFT_LOW + SOFT_HIGH) * 255  # of 255: the soft mask's value where the alpha is a half
CLOTHES = 0.006  # of the body's height: a centimetre that clothes stand off an adult
SEEN_EDGE = 0.015  # of the body's height: so near to what is visible, the visible edge is the person's own
REACH = 0.12  # of the body's height: what lies farther from the fitted body is not this person
SUPERSAMPLING = 2
MIN_DEPTH = 1e-3  # metres: nearer points count as behind the camera
VISIBLE = 127  # of 255: more than half


@dataclass(frozen=True)
class FrameMasks:
    """Masks of one frame.

    Attributes:
        visible: [H,W] uint8 alpha of the visible part.
        amodal: [H,W] uint8 the whole person, hidden parts included: the body, and what is visible.
        box: [4] float32, x0, y0, x1, y1 of the visible part in pixels; zeros where nothing is visible.
        occluded: share in [0,1] of the silhouette inside the picture that is not visible.
    """

    visible: NDArray[np.uint8]
    amodal: NDArray[np.uint8]
    box: NDArray[np.float32]
    occluded: float


def frame_masks(soft: NDArray[np.uint8], silhouette: NDArray[np.uint8]) -> FrameMasks:
    """Turn a refined mask into the visible person's alpha, and a naked silhouette into the whole person's.

    Args:
        soft: [H,W], 0 to 255.
        silhouette: [H,W] of the fitted body.
    """
    part = np.clip((soft.astype(np.float32) / 255.0 - SOFT_LOW) / (SOFT_HIGH - SOFT_LOW), 0.0, 1.0)
    alpha = part * part * (3.0 - 2.0 * part) * near_body(silhouette)
    visible = np.round(alpha * 255).astype(np.uint8)
    body, seen = silhouette > VISIBLE, visible > VISIBLE
    occluded = 1.0 - float((body & seen).sum()) / max(int(body.sum()), 1) if body.any() else 0.0
    return FrameMasks(visible, np.maximum(clothed(silhouette, visible), visible), mask_box(visible), occluded)


def refine(frame: NDArray[np.uint8], soft: NDArray[np.float32], crop_size: float) -> NDArray[np.uint8]:
    """Move a soft mask's edges to the picture's.

    Args:
        frame: [H,W,3] sRGB.
        soft: [H,W] in [0,1], the network's mask in the image.
        crop_size: side in pixels of the square that the network saw.

    Returns:
        [H,W], 0 to 255.
    """
    radius = max(1, round(GUIDE_CELLS * crop_size / CELLS))
    rows, columns = np.flatnonzero(soft.any(1)), np.flatnonzero(soft.any(0))
    result = np.zeros(soft.shape, np.uint8)
    if len(rows):
        part = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        guide = frame[part].astype(np.float32) / 255.0
        filtered = guided_filter(guide, np.ascontiguousarray(soft[part]), radius, GUIDE_EPS)
        result[part] = np.round(np.clip(filtered, 0.0, 1.0) * 255).astype(np.uint8)
    return result


def clothed(body: NDArray[np.uint8], visible: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A naked silhouette [H,W] widened by what clothes take, where nothing visible shows how wide it is."""
    height = _extent(body)
    if height <= 0:
        return body
    beside, unseen = (
        cv2.distanceTransform((mask <= VISIBLE).astype(np.uint8), cv2.DIST_L2, 5) for mask in (body, visible)
    )
    wider = 255 * np.clip(CLOTHES * height + 0.5 - beside, 0.0, 1.0)
    return np.where(unseen > SEEN_EDGE * height, np.maximum(body, np.round(wider)), body).astype(np.uint8)


def _extent(mask: NDArray[np.uint8]) -> float:
    """Pixels across a mask's box, the longer way; 0 if it is empty."""
    box = mask_box(mask)
    return float(max(box[3] - box[1], box[2] - box[0]))


def near_body(amodal: NDArray[np.uint8]) -> NDArray[np.float32]:
    """1 on the body, falling to 0 at `REACH` of its height: clothes and hair are kept, other people are not. [H,W]."""
    height = _extent(amodal)
    if height <= 0:
        return np.ones(amodal.shape, np.float32)
    away = cv2.distanceTransform((amodal <= VISIBLE).astype(np.uint8), cv2.DIST_L2, 3)
    return np.asarray(np.clip(2.0 - 2.0 * away / (REACH * height), 0.0, 1.0), dtype=np.float32)


def silhouette(
    vertices: NDArray[np.floating], faces: NDArray[np.integer], K: NDArray[np.floating], height: int, width: int
) -> NDArray[np.uint8]:
    """Fill the triangles of a posed body, seen by `OBSERVED_VIEWMAT`.

    Args:
        vertices: [V,3] metres, world.
        faces: [F,3].
        K: [3,3] pixels.
        height: of the picture.
        width: of the picture.

    Returns:
        [height,width] coverage, 0 to 255. Triangles that reach behind the camera are left out.
    """
    points, in_front = project_points(vertices, K)
    facing = faces_camera(points, faces) & in_front[faces].all(axis=1)
    fine = np.zeros((height * SUPERSAMPLING, width * SUPERSAMPLING), np.uint8)
    fill_triangles(fine, points * SUPERSAMPLING, faces[facing])
    return np.asarray(cv2.resize(fine, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)


def project_points(
    vertices: NDArray[np.floating], K: NDArray[np.floating]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Pixels [V,2] of points [V,3] seen by `OBSERVED_VIEWMAT`, and whether each is in front of the camera."""
    depth = vertices[:, 1].astype(np.float64)
    in_front = depth > MIN_DEPTH
    safe = np.where(in_front, depth, 1.0)
    across = vertices[:, 0] / safe * K[0, 0] + K[0, 2]
    return np.stack([across, -vertices[:, 2] / safe * K[1, 1] + K[1, 2]], axis=1), in_front


def faces_camera(points: NDArray[np.float64], faces: NDArray[np.integer]) -> NDArray[np.bool_]:
    """Whether each triangle [F] shows its outside, from its corners' pixels [V,2]."""
    corner = points[faces[:, 0]]
    a, b = points[faces[:, 1]] - corner, points[faces[:, 2]] - corner
    # Pictures have y down, so outward triangles (counter-clockwise seen from outside) turn the other way round here.
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0] < 0)


def mask_box(mask: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return x0, y0, x1, y1 (exclusive) round pixels above half; zeros if there are none."""
    rows, columns = np.flatnonzero((mask > VISIBLE).any(1)), np.flatnonzero((mask > VISIBLE).any(0))
    if len(rows) == 0:
        return np.zeros(4, np.float32)
    return np.array([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1], np.float32)
