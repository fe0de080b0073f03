"""Finding cuts between shots.

A cut is a moment where everything before differs from everything after, in colours and in layout, by more than the
video usually changes around it. So a flash is none (the old picture comes back), nor is a fast pan (the steps beside
it are as large). Slow dissolves have no such moment and are not found.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np
from pydantic import BaseModel, ConfigDict, Field

THUMBNAIL = 96  # longest side in pixels at which pictures are compared
_GRID = 24  # layout is compared on a grid of so many cells a side: blind to noise and small motion
_BINS = 8  # a colour channel
_MIN_CONTRAST = 4.0  # 8-bit levels; flatter pictures have no layout, and noise must not pass for one


class ShotConfig(BaseModel):
    """How cuts are found.

    Attributes:
        threshold: difference in [0,1] that a cut has at least.
        ratio: a cut differs so many times more than the median change beside it.
        neighbourhood: frames on each side from which that median is taken.
        return_frames: if a picture from before comes back within so many frames, the change was a flash. Also the
            length of the shortest shot that is found for sure.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    threshold: float = Field(default=0.25, gt=0.0, lt=1.0)
    ratio: float = Field(default=2.5, ge=1.0)
    neighbourhood: int = Field(default=6, ge=1)
    return_frames: int = Field(default=4, ge=1)


@dataclass(frozen=True)
class _Look:
    colours: np.ndarray  # float32 [3 * bins^2], sums to 1
    layout: np.ndarray  # float32 [grid^2], zero mean, unit length; zero if the picture is flat


class ShotDetector:
    """Takes pictures one by one, keeps a handful of thumbnails, and tells the cuts at the end."""

    def __init__(self, config: ShotConfig | None = None) -> None:
        self._config = config or ShotConfig()
        self._recent: deque[_Look] = deque(maxlen=2 * self._config.return_frames)
        self._steps: list[float] = []  # difference of picture t to t - 1, from t = 1
        self._lasting: list[float] = []  # smallest difference across t between the pictures around it, from t = 1
        self._count = 0

    def add(self, picture: np.ndarray) -> None:
        """Take the next picture.

        Args:
            picture: uint8 RGB [H,W,3], a thumbnail of about `THUMBNAIL` pixels; all of one size.
        """
        look = _look(picture)
        if self._recent:
            self._steps.append(_difference(self._recent[-1], look))
        self._recent.append(look)
        self._count += 1
        # The step into picture t is judged once `return_frames` pictures from t on are known.
        judged = self._count - self._config.return_frames
        if judged >= 1:
            self._lasting.append(self._across(len(self._recent) - self._config.return_frames))

    def cuts(self) -> list[int]:
        """Positions (in order of `add`, from 0) of the first picture of every shot but the first."""
        lasting = list(self._lasting)
        while len(lasting) < len(self._steps):
            remaining = len(self._steps) - len(lasting)
            lasting.append(self._across(len(self._recent) - remaining))
        return [t + 1 for t, step in enumerate(lasting) if step > self._bar(t)]

    def _across(self, split: int) -> float:
        """Smallest difference between a picture before and one from `split` on, within reach of a flash."""
        recent = list(self._recent)
        reach = self._config.return_frames
        before, after = recent[max(0, split - reach) : split], recent[split : split + reach]
        return min(_difference(a, b) for a in before for b in after)

    def _bar(self, t: int) -> float:
        reach = self._config.neighbourhood
        sides = (self._steps[max(0, t - reach) : t], self._steps[t + 1 : t + 1 + reach])
        usual = max((float(np.median(side)) for side in sides if side), default=0.0)
        return max(self._config.threshold, self._config.ratio * usual)


def _look(picture: np.ndarray) -> _Look:
    small = cv2.resize(picture, (_GRID, _GRID), interpolation=cv2.INTER_AREA)
    pairs = ((0, 1), (1, 2), (2, 0))
    histograms = [cv2.calcHist([picture], list(p), None, [_BINS, _BINS], [0, 256, 0, 256]).ravel() for p in pairs]
    colours = np.concatenate(histograms)
    grey = small.astype(np.float32).mean(axis=2).ravel()
    grey -= grey.mean()
    length = float(np.linalg.norm(grey))
    flat = length < _MIN_CONTRAST * _GRID
    return _Look(colours / colours.sum(), np.zeros_like(grey) if flat else grey / length)


def _difference(a: _Look, b: _Look) -> float:
    """Mean of colour difference (1 - histogram intersection) and layout difference (1 - correlation), each in [0,1]."""
    colour = 1.0 - float(np.minimum(a.colours, b.colours).sum())
    # Two flat pictures have the same layout: none.
    alike = float(a.layout @ b.layout) if a.layout.any() or b.layout.any() else 1.0
    return 0.5 * (colour + min(1.0, 1.0 - alike))
