"""Facial expression from the face landmark network (MediaPipe's face mesh, 468 points) on the head's crop.

The network's answer is laid on a reference face by a similarity over points that no expression moves; a few distances
are measured there (how far the lips, the eyes, the brows are apart), and a linear map turns them into the body's
facial actions. The map was learned on rendered heads whose actions were known (`python -m benchmarks.train_face`). What
a face shows at rest over the clip counts as neutral: people's faces differ more at rest than expressions move them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib import resources

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import load

from ahoy_core.perceive.crop import Roi, sample
from ahoy_core.perceive.networks import FACE_SIZE, Networks

ASSET = "face.safetensors"
# Between the eyes, forehead, temples, inner and outer corners of the eyes: what expressions move least.
STABLE = (10, 151, 9, 8, 168, 6, 197, 195, 33, 133, 362, 263, 127, 356, 234, 454, 109, 338, 67, 297, 103, 332, 21, 251)
EYES, MOUTH = (2, 5), (9, 10)  # of the 33 body landmarks
CORNERS = (33, 263)  # outer corners of the eyes, of the 468: they give the crop's tilt
FACE_CROP = 4.7  # side of the first crop over the distance of eyes and mouth
DOWN = 0.35  # of that distance from the eyes to the middle of the face
MARGIN = 1.5  # of the second crop over the landmarks' box, as the network was trained
MIN_FACE, SURE_FACE = 28.0, 80.0  # pixels of the crop's side in the video: below nothing is read, above all is believed
TURN = (0.55, 0.9)  # of pi/2: heads turned by less are believed, by more are not
MIN_FRAMES = 8  # with fewer, no resting face is taken off
REST = 0.2  # quantile over the clip that counts as the face at rest
# Distances that are measured on a face: (first point, second point or None, axis), of the 468; y is down.
MEASURES: tuple[tuple[int, int | None, int], ...] = (
    (14, 13, 1), (291, 61, 0), (61, 13, 1), (291, 13, 1), (152, None, 1), (152, None, 0), (61, None, 0), (291, None, 0),
    (0, None, 1), (17, None, 1), (13, 0, 1), (17, 14, 1), (145, 159, 1), (374, 386, 1), (144, 160, 1), (373, 387, 1),
    (55, None, 1), (285, None, 1), (107, None, 1), (336, None, 1), (46, None, 1), (276, None, 1), (52, None, 1),
    (282, None, 1), (285, 55, 0), (48, None, 1), (278, None, 1), (205, None, 0), (425, None, 0), (152, None, 2),
    (13, None, 2), (119, None, 1), (348, None, 1),
)  # fmt: skip


@dataclass(frozen=True)
class FaceReading:
    """One face: points [468,3] in image pixels (z negative towards the viewer), score in [0,1], and its crop."""

    points: NDArray[np.float64]
    score: float
    roi: Roi


@dataclass(frozen=True)
class FaceMap:
    """The packaged map.

    Attributes:
        reference: [468,3] points of the average resting face, unit size.
        middle: [M] measures of that face.
        weights: [M,E].
        skill: [E] in [0,1], correlation with the truth on rendered heads that were held out.
    """

    reference: NDArray[np.float32]
    middle: NDArray[np.float32]
    weights: NDArray[np.float32]
    skill: NDArray[np.float32]


@cache
def load_face_map() -> FaceMap:
    """The map in the package's assets (`ahoy_core/assets/face.md` says what it was learned on)."""
    arrays = load(resources.files("ahoy_core.assets").joinpath(ASSET).read_bytes())
    return FaceMap(**{name: value.astype(np.float32) for name, value in arrays.items()})


def read_face(networks: Networks, frame: NDArray[np.uint8], landmarks: NDArray[np.floating]) -> FaceReading | None:
    """Read the face of a person whose body landmarks are known.

    Args:
        networks: with the face network among them.
        frame: [H,W,3] sRGB.
        landmarks: [33,2] pixels.

    Returns:
        None where the face is too small, or mostly out of the picture.
    """
    roi = first_crop(landmarks)
    if roi is None or not _inside(roi, frame.shape):
        return None
    rough = read_crop(networks, frame, roi)
    again = second_crop(rough.points)
    return read_crop(networks, frame, again) if again.size >= MIN_FACE else None


def first_crop(landmarks: NDArray[np.floating]) -> Roi | None:
    """The square round the face of body landmarks [33,2]; None where it is smaller than `MIN_FACE`."""
    eyes, mouth = landmarks[list(EYES)].mean(0), landmarks[list(MOUTH)].mean(0)
    down = mouth - eyes
    size = FACE_CROP * float(np.hypot(*down))
    if not size >= MIN_FACE:
        return None
    centre = eyes + DOWN * down
    return Roi(float(centre[0]), float(centre[1]), size, float(np.arctan2(down[1], down[0]) - np.pi / 2))


def second_crop(points: NDArray[np.floating]) -> Roi:
    """The square round face landmarks [468,3], eyes level."""
    left, right = points[CORNERS[0], :2], points[CORNERS[1], :2]
    angle = float(np.arctan2(right[1] - left[1], right[0] - left[0]))
    c, s = np.cos(angle), np.sin(angle)
    upright = points[:, :2] @ np.array([[c, -s], [s, c]])
    low, high = upright.min(0), upright.max(0)
    centre = np.array([[c, -s], [s, c]]) @ (0.5 * (low + high))
    return Roi(float(centre[0]), float(centre[1]), max(1.0, MARGIN * float((high - low).max())), angle)


def read_crop(networks: Networks, frame: NDArray[np.uint8], roi: Roi) -> FaceReading:
    """Run the network on one crop and lay its points back into the image."""
    points, score = networks.face(sample(frame, roi, FACE_SIZE))
    unit = points.astype(np.float64) / FACE_SIZE
    return FaceReading(np.concatenate([roi.to_image(unit[:, :2]), unit[:, 2:] * roi.size], axis=1), score, roi)


def on_reference(points: NDArray[np.floating], reference: NDArray[np.floating]) -> tuple[NDArray[np.float64], float]:
    """Lay points [468,3] on a reference by the similarity of `STABLE`; also the angle that the head is turned away.

    Returns:
        Points [468,3] in the reference's frame, and radians between the face's forward axis and the line of sight.
    """
    stable = list(STABLE)
    a, b = np.asarray(points, np.float64)[stable], np.asarray(reference, np.float64)[stable]
    middle, target = a.mean(0), b.mean(0)
    u, s, vt = np.linalg.svd((a - middle).T @ (b - target))
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * sign) @ vt
    scale = float((s * sign).sum() / max(float(((a - middle) ** 2).sum()), 1e-12))
    forward = rotation[:, 2]  # the reference's z axis, in the image
    return scale * (points - middle) @ rotation + target, float(np.arccos(np.clip(abs(forward[2]), 0, 1)))


def measures(placed: NDArray[np.floating]) -> NDArray[np.float64]:
    """What the map reads [M] of a face that lies on the reference, [468,3]."""
    return np.array([placed[a, k] - (placed[b, k] if b is not None else 0.0) for a, b, k in MEASURES], np.float64)


def expressions(readings: list[FaceReading | None], actions: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Facial actions and how sure they are.

    Args:
        readings: one a frame.
        actions: E, of the body; another number than the map knows gives neutral faces.

    Returns:
        expression [T,E] in [0,1] and confidence [T] in [0,1]; neutral with confidence 0 where no face was read.
    """
    known = load_face_map()
    expression = np.zeros((len(readings), actions), np.float32)
    confidence = np.zeros(len(readings), np.float32)
    if actions != known.weights.shape[1]:
        return expression, confidence
    for t, reading in enumerate(readings):
        if reading is None:
            continue
        placed, turned = on_reference(reading.points, known.reference)
        expression[t] = (measures(placed) - known.middle) @ known.weights
        size = np.clip((reading.roi.size - MIN_FACE) / (SURE_FACE - MIN_FACE), 0, 1)
        facing = np.clip((TURN[1] - turned / (np.pi / 2)) / (TURN[1] - TURN[0]), 0, 1)
        confidence[t] = reading.score * size * facing if reading.score > 0.5 else 0.0
    sure = confidence > 0
    if sure.sum() >= MIN_FRAMES:
        expression[sure] -= np.quantile(expression[sure], REST, axis=0).astype(np.float32)
    expression[~sure] = 0.0
    return np.clip(expression, 0.0, 1.0), confidence


def _inside(roi: Roi, shape: tuple[int, ...]) -> bool:
    """Whether the square's middle lies in the picture."""
    return 0 <= roi.cx < shape[1] and 0 <= roi.cy < shape[0]
