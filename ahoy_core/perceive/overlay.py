"""Pictures to check a fit by: the body, the landmarks and the mask drawn on frames."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from ahoy_core.body.model import BodyModel
from ahoy_core.perceive.masks import VISIBLE, mask_box

if TYPE_CHECKING:
    from ahoy_core.perceive.perceive import Perception

TILE = 480  # pixels, height and width
SHEET_WIDTH = 2000  # pixels
MARGIN = 0.15  # of the subject's box, left free on each side of it
MASK_TINT = (60, 200, 90)
BONES = (
    (11, 12), (11, 13), (13, 15), (12, 14), (14, 16), (11, 23), (12, 24), (23, 24), (23, 25),
    (25, 27), (24, 26), (26, 28), (27, 29), (29, 31), (28, 30), (30, 32), (15, 19), (16, 20),
)  # fmt: skip
LEFT, RIGHT, UNSEEN = (255, 170, 40), (60, 170, 255), (150, 150, 150)


def contact_sheet(
    frames: NDArray[np.uint8], perception: Perception, body: BodyModel, columns: int | None = None, tiles: int = 8
) -> NDArray[np.uint8]:
    """Draw evenly spaced used frames, cropped to the subject at one scale.

    The left half of each tile shows the mask and the landmarks, the right half the fitted body.

    Args:
        frames: [T,H,W,3] sRGB.
        perception: what was perceived in them.
        body: the body that was fitted.
        columns: tiles across; as many as fit `SHEET_WIDTH` unless given.
        tiles: at most this many.

    Returns:
        [H',W',3] uint8.
    """
    used = np.flatnonzero(perception.used)
    chosen = used[np.unique(np.linspace(0, len(used) - 1, tiles).round().astype(int))]
    boxes = subject_boxes(perception, chosen)
    # One side for all: a tile's size says how large the person is.
    side = max(1.0, (1 + 2 * MARGIN) * float((boxes[:, 2:] - boxes[:, :2]).max()))
    centres = 0.5 * (boxes[:, :2] + boxes[:, 2:])
    drawn = [
        np.concatenate(draw_frame(frames[t], perception, body, int(t), centre, side), axis=1)
        for t, centre in zip(chosen, centres, strict=True)
    ]
    across = min(columns or max(1, SHEET_WIDTH // drawn[0].shape[1]), len(drawn))
    drawn += [np.zeros_like(drawn[0])] * (-len(drawn) % across)
    return np.concatenate([np.concatenate(drawn[i : i + across], axis=1) for i in range(0, len(drawn), across)])


def subject_boxes(perception: Perception, chosen: NDArray[np.integer]) -> NDArray[np.float64]:
    """Boxes [n,4] (x0, y0, x1, y1) round the visible person and the fitted body inside the picture, in n frames."""
    boxes = []
    for t in chosen.tolist():
        shown = mask_box(np.maximum(perception.visible[t], perception.amodal[t]))
        height, width = perception.visible[t].shape
        boxes.append(shown if shown.any() else np.array([0, 0, width, height]))
    return np.asarray(boxes, np.float64)


def draw_frame(
    frame: NDArray[np.uint8],
    perception: Perception,
    body: BodyModel,
    t: int,
    centre: NDArray[np.floating],
    side: float,
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return two pictures [TILE,TILE,3] of a square of one frame: mask and landmarks, and the shaded body.

    Args:
        frame: [H,W,3] sRGB.
        perception: what was perceived.
        body: the body that was fitted.
        t: number of the frame.
        centre: [2] of the square, pixels of the frame.
        side: of the square, pixels; what lies beyond the frame is black.
    """
    scale = TILE / side
    shift = TILE / 2 - scale * np.asarray(centre, np.float64)
    picture, mask = (_crop(image, scale, shift) for image in (frame, perception.visible[t]))
    seen = draw_mask(picture, mask)
    landmarks = perception.landmarks[t].astype(np.float64)
    draw_landmarks(seen, np.concatenate([landmarks[:, :2] * scale + shift, landmarks[:, 2:]], axis=1))
    with torch.no_grad():
        posed = body(
            torch.from_numpy(perception.pose[t : t + 1]),
            torch.from_numpy(perception.betas)[None],
            torch.from_numpy(perception.transl[t : t + 1]),
        )
    K = perception.K.astype(np.float64) * np.array([[scale], [scale], [1.0]])
    K[:2, 2] += shift
    return seen, draw_body(picture, posed.vertices[0].numpy(), body.faces.numpy(), K)


def _crop(image: NDArray[np.uint8], scale: float, shift: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Scale and shift an image into a tile; pixel centres at +0.5."""
    # Sampling alone would alias where the tile is smaller than what it shows.
    smooth = cv2.GaussianBlur(image, (0, 0), 0.5 / scale) if scale < 1 else image
    offset = shift + 0.5 * scale - 0.5
    matrix = np.array([[scale, 0.0, offset[0]], [0.0, scale, offset[1]]])
    return np.asarray(cv2.warpAffine(smooth, matrix, (TILE, TILE), flags=cv2.INTER_LINEAR), dtype=np.uint8)


def draw_mask(picture: NDArray[np.uint8], mask: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Tint what the mask covers, darken the rest and draw its outline."""
    alpha = mask[..., None].astype(np.float32) / 255.0
    tinted = 0.65 * picture + 0.35 * np.array(MASK_TINT, np.float32)
    result = np.ascontiguousarray((alpha * tinted + (1 - alpha) * 0.45 * picture).astype(np.uint8))
    outlines, _ = cv2.findContours((mask > VISIBLE).astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(result, outlines, -1, MASK_TINT, 1, cv2.LINE_AA)
    return result


def draw_landmarks(picture: NDArray[np.uint8], landmarks: NDArray[np.floating]) -> None:
    """Draw bones and points [33,3] (x, y, visibility) in place: left orange, right blue, hidden ones grey."""
    points = [(round(float(x)), round(float(y))) for x, y in landmarks[:, :2]]
    for a, b in BONES:
        hidden = min(landmarks[a, 2], landmarks[b, 2]) < 0.5
        colour = UNSEEN if hidden else (LEFT if a % 2 and b % 2 else RIGHT if not (a % 2 or b % 2) else (255, 255, 255))
        cv2.line(picture, points[a], points[b], colour, 1, cv2.LINE_AA)
    for i, point in enumerate(points):
        colour = UNSEEN if landmarks[i, 2] < 0.5 else (LEFT if i % 2 else RIGHT)
        cv2.circle(picture, point, 2, colour, -1, cv2.LINE_AA)


def draw_body(
    picture: NDArray[np.uint8],
    vertices: NDArray[np.floating],
    faces: NDArray[np.integer],
    K: NDArray[np.floating],
    opacity: float = 0.6,
) -> NDArray[np.uint8]:
    """Lay the shaded body over a picture, far triangles first; vertices [V,3] world, K in this picture's pixels."""
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True) + 1e-12
    centres = corners.mean(axis=1)
    shade = -np.einsum("ni,ni->n", normals, centres / (np.linalg.norm(centres, axis=1, keepdims=True) + 1e-12))
    drawn = np.flatnonzero((shade > 0) & (corners[..., 1].min(1) > 1e-3))
    drawn = drawn[np.argsort(-centres[drawn, 1])]
    depth = np.maximum(vertices[:, 1], 1e-3)
    pixels = np.stack([vertices[:, 0] / depth * K[0, 0] + K[0, 2], -vertices[:, 2] / depth * K[1, 1] + K[1, 2]], axis=1)
    limit = 4.0 * max(picture.shape)
    fixed = np.round(np.clip(pixels - 0.5, -limit, limit) * 16).astype(np.int32)
    layer = picture.copy()
    for face in drawn:
        light = float(shade[face])
        cv2.fillConvexPoly(
            layer, fixed[faces[face]], (60 + 150 * light, 100 + 140 * light, 90 + 165 * light), cv2.LINE_8, 4
        )
    return np.asarray(cv2.addWeighted(picture, 1 - opacity, layer, opacity, 0.0), dtype=np.uint8)
