"""Rooms of boxes: floor, walls with pictures, and furniture between the camera and the person."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
FACES = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
SIZE = 128


@dataclass(frozen=True)
class Box:
    """A box in the world: corners [8,3] (x fastest last), a texture, and how many metres the texture spans."""

    corners: FloatArray
    texture: NDArray[np.uint8]
    span: float = 1.0


def box(low: tuple[float, ...], high: tuple[float, ...], texture: NDArray[np.uint8], span: float = 1.0) -> Box:
    """A box along the axes."""
    x, y, z = zip(low, high, strict=True)
    corners = np.array([[a, b, c] for a in x for b in y for c in z])
    return Box(corners, texture, span)


def turned(boxes: list[Box], degrees: float, about: tuple[float, float]) -> list[Box]:
    """Boxes turned about a vertical line."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    middle = np.array([*about, 0.0])
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return [Box((b.corners - middle) @ rotation.T + middle, b.texture, b.span) for b in boxes]


def mesh(item: Box) -> tuple[FloatArray, NDArray[np.int64], FloatArray]:
    """Vertices [8,3], triangles [12,3] and their corners' texture coordinates [12,3,2]."""
    corners = item.corners
    edges = [
        np.linalg.norm(corners[4] - corners[0]),
        np.linalg.norm(corners[2] - corners[0]),
        np.linalg.norm(corners[1] - corners[0]),
    ]
    local = np.array([[a, b, c] for a in (0, edges[0]) for b in (0, edges[1]) for c in (0, edges[2])]) / item.span
    faces, uvs = [], []
    for number, quad in enumerate(FACES):
        kept = [k for k in range(3) if k != number // 2]
        place = local[quad][:, kept] + 0.37 * number
        for triangle in ((0, 1, 2), (0, 2, 3)):
            faces.append(quad[list(triangle)])
            uvs.append(place[list(triangle)])
    return corners, np.array(faces), np.array(uvs)


def sample_room(rng: np.random.Generator) -> list[Box]:
    """Floor, back and side walls, pictures on the back wall."""
    back = rng.uniform(0.9, 2.5)
    wall = _speckled(rng, rng.uniform(90, 225, 3) * 0.4 + 0.6 * rng.uniform(120, 220), 3)
    boxes = [
        box((-6, -6, -0.05), (6, back + 0.1, 0), _planks(rng), rng.uniform(0.7, 1.6)),
        box((-6, back, 0), (6, back + 0.1, 4.5), wall, 2.0),
        box((-3.6, -6, 0), (-3.5, back, 4.5), wall, 2.0), box((3.5, -6, 0), (3.6, back, 4.5), wall, 2.0),
        box((-6, back - 0.02, 0), (6, back, 0.12), _speckled(rng, np.full(3, 215.0), 2), 1.0),
    ]  # fmt: skip
    for _ in range(int(rng.integers(0, 4))):
        x, z, w, h = rng.uniform(-2, 2), rng.uniform(1.2, 2.2), rng.uniform(0.2, 0.5), rng.uniform(0.2, 0.5)
        boxes.append(
            box((x - w, back - 0.04, z - h), (x + w, back - 0.01, z + h), _speckled(rng, rng.uniform(15, 110, 3), 2))
        )
        inner = (x - w + 0.05, back - 0.05, z - h + 0.05), (x + w - 0.05, back - 0.04, z + h - 0.05)
        boxes.append(box(*inner, _blurred(rng)))
    if rng.random() < 0.4:
        x = rng.choice([-1, 1]) * rng.uniform(0.9, 1.8)
        boxes += _shelf(rng, x, back - 0.4, rng.uniform(0.8, 1.9))
    return boxes


def sample_occluders(rng: np.random.Generator, kind: str) -> list[Box]:
    """Furniture in front of somebody near the origin who faces -y."""
    y = -rng.uniform(0.5, 1.0)
    if kind == "desk":
        boxes = _desk(rng, rng.normal(0, 0.25), y, rng.uniform(0.68, 0.95))
    elif kind == "shelf":
        boxes = _shelf(rng, rng.choice([-1, 1]) * rng.uniform(0.1, 0.45), y, rng.uniform(0.7, 1.35))
    elif kind == "chair":
        boxes = _chair(rng, rng.normal(0, 0.25), y)
    elif kind == "counter":
        x, w = rng.normal(0, 0.3), rng.uniform(0.4, 1.2)
        boxes = [box((x - w, y - 0.3, 0), (x + w, y, rng.uniform(0.7, 1.1)), _wood(rng), 0.8)]
    elif kind == "post":
        x, w = rng.normal(0, 0.25), rng.uniform(0.06, 0.16)
        boxes = [box((x - w, y - 0.2, 0), (x + w, y, 3), _speckled(rng, rng.uniform(40, 220, 3), 6), 1)]
    else:
        return []
    boxes = turned(boxes, rng.normal(0, 12), (0, y))
    if rng.random() < 0.3:
        x = rng.choice([-1, 1]) * rng.uniform(0.4, 0.8)
        boxes += _chair(rng, x, y + rng.uniform(-0.2, 0.1), stool=True)
    return boxes


def carried_box(rng: np.random.Generator, left: FloatArray, right: FloatArray, forward: FloatArray) -> list[Box]:
    """A box [T of them] between the hands: left, right [T,3] metres, forward [T,3] unit."""
    depth, height = rng.uniform(0.1, 0.2), rng.uniform(0.1, 0.25)
    texture = _speckled(
        rng, np.array([176, 130, 84]) * rng.uniform(0.7, 1.2) if rng.random() < 0.6 else rng.uniform(30, 220, 3), 6
    )
    lift = rng.uniform(-0.3, 0.5) * height
    boxes = []
    for a, b, f in zip(left, right, forward, strict=True):
        half, middle = 0.5 * (a - b), 0.5 * (a + b) + 0.5 * depth * f + [0, 0, lift]
        corners = [
            middle + s * half + t * depth * f + u * height / 2 * np.array([0, 0, 1.0])
            for s in (-1, 1)
            for t in (-0.6, 0.6)
            for u in (-1, 1)
        ]
        boxes.append(Box(np.array(corners), texture, 0.6))
    return boxes


def _desk(rng: np.random.Generator, x: float, y: float, top: float) -> list[Box]:
    wood, dark, w = _wood(rng), _speckled(rng, rng.uniform(25, 90, 3), 2), rng.uniform(0.5, 0.9)
    boxes = [box((x - w, y - 0.6, top - 0.04), (x + w, y, top), wood, 0.8)]
    for a in (x - w + 0.06, x + w - 0.06):
        boxes += [box((a - 0.03, b - 0.03, 0), (a + 0.03, b + 0.03, top - 0.04), dark) for b in (y - 0.55, y - 0.05)]
    if rng.random() < 0.6:
        boxes.append(
            box((x - w + 0.1, y - 0.08, rng.uniform(0.2, 0.5)), (x + w - 0.1, y - 0.05, top - 0.04), wood, 0.8)
        )
    if rng.random() < 0.7:
        a, h = x + rng.uniform(-0.35, 0.35), rng.uniform(0.22, 0.4)
        boxes.append(box((a - 0.28, y - 0.3, top + 0.08), (a + 0.28, y - 0.27, top + 0.08 + h), dark))
        boxes.append(box((a - 0.03, y - 0.3, top), (a + 0.03, y - 0.27, top + 0.1), dark))
    if rng.random() < 0.5:
        a = x + rng.uniform(-0.6, 0.6)
        card = _speckled(rng, np.array([176.0, 130, 84]), 6)
        boxes.append(box((a - 0.16, y - 0.4, top), (a + 0.16, y - 0.1, top + rng.uniform(0.12, 0.3)), card, 0.6))
    return boxes


def _shelf(rng: np.random.Generator, x: float, y: float, top: float) -> list[Box]:
    wood, w, n = _wood(rng), rng.uniform(0.25, 0.45), int(rng.integers(2, 5))
    boxes = [box((s - 0.02, y - 0.3, 0), (s + 0.02, y, top), wood, 0.8) for s in (x - w, x + w)]
    boxes.append(box((x - w, y - 0.02, 0), (x + w, y, top), _speckled(rng, rng.uniform(30, 120, 3), 2)))
    for z in np.linspace(0.02, top, n + 1):
        boxes.append(box((x - w, y - 0.3, z - 0.03), (x + w, y, z), wood, 0.8))
        place = x - w + 0.03
        while z < top - 0.1 and place < x + w - 0.08:
            thick, high = rng.uniform(0.02, 0.06), rng.uniform(0.5, 0.85) * top / n
            boxes.append(
                box(
                    (place, y - 0.26, z),
                    (place + thick, y - 0.06, z + high),
                    _speckled(rng, rng.uniform(20, 210, 3), 4),
                )
            )
            place += thick + 0.004
    return boxes


def _chair(rng: np.random.Generator, x: float, y: float, stool: bool = False) -> list[Box]:
    wood, seat, w = _wood(rng), rng.uniform(0.42, 0.52), rng.uniform(0.18, 0.25)
    boxes = [box((x - w, y - w, seat - 0.04), (x + w, y + w, seat), wood, 0.6)]
    boxes += [
        box((a - 0.02, b - 0.02, 0), (a + 0.02, b + 0.02, seat), wood)
        for a in (x - w + 0.03, x + w - 0.03)
        for b in (y - w + 0.03, y + w - 0.03)
    ]
    if not stool:
        back = rng.uniform(0.35, 0.6)
        boxes.append(box((x - w, y + w - 0.04, seat), (x + w, y + w, seat + back), wood, 0.6))
    return boxes


def _speckled(rng: np.random.Generator, colour: FloatArray, noise: float) -> NDArray[np.uint8]:
    colour = 0.5 * colour + 0.5 * colour.mean()  # rooms are duller than random colours
    coarse = cv2.resize(rng.normal(0, noise, (8, 8)), (SIZE, SIZE), interpolation=cv2.INTER_CUBIC)
    return _image(colour + coarse[..., None] + rng.normal(0, noise, (SIZE, SIZE, 1)))


def _blurred(rng: np.random.Generator) -> NDArray[np.uint8]:
    return _image(
        cv2.resize(
            rng.uniform(0, 60, (5, 5, 3)) + rng.uniform(60, 160, (5, 5, 1)), (SIZE, SIZE), interpolation=cv2.INTER_CUBIC
        )
    )


def _wood(rng: np.random.Generator) -> NDArray[np.uint8]:
    tone = np.array([(196, 150, 96), (120, 76, 46), (226, 196, 150), (90, 60, 44), (200, 198, 194)][rng.integers(5)])
    grain = cv2.resize(rng.normal(0, 14, (SIZE // 4, 4)), (SIZE, SIZE), interpolation=cv2.INTER_LINEAR)
    return _image(tone * rng.uniform(0.8, 1.15) + grain[..., None])


def _planks(rng: np.random.Generator) -> NDArray[np.uint8]:
    if rng.random() < 0.3:
        return _speckled(rng, rng.uniform(60, 190, 3), 9)
    image = _wood(rng)[..., :3].astype(np.float64).transpose(1, 0, 2)
    for number, column in enumerate(range(0, SIZE, SIZE // 8)):
        image[:, column : column + SIZE // 8] *= rng.uniform(0.8, 1.1)
        image[:, column : column + 2] *= 0.6
        image[(number * 97) % SIZE : (number * 97) % SIZE + 2, column : column + SIZE // 8] *= 0.6
    return _image(image)


def _image(values: FloatArray) -> NDArray[np.uint8]:
    alpha = np.full((*values.shape[:2], 1), 255.0)
    full = np.broadcast_to(values, (*values.shape[:2], 3))
    return np.clip(np.concatenate([full, alpha], axis=2), 0, 255).astype(np.uint8)
