"""Biovision hierarchy (`.bvh`) motion files: the tree of joints and the numbers of every frame."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ahoy_core.formats.errors import BvhError

_CHANNELS = tuple(f"{axis}{kind}" for kind in ("position", "rotation") for axis in "XYZ")
_MAX_JOINTS = 10_000


@dataclass(frozen=True)
class BvhJoint:
    """One joint: its parent's number (-1 for the root), its offset from the parent, and its channels in file order."""

    name: str
    parent: int
    offset: tuple[float, float, float]
    channels: tuple[str, ...]


@dataclass(frozen=True)
class Bvh:
    """A file: joints (parents before children), end sites as (joint, offset), `values` [T,C] in channel order.

    Angles are in degrees and lengths in whatever unit the file was made with, as stored.
    """

    joints: tuple[BvhJoint, ...]
    ends: tuple[tuple[int, tuple[float, float, float]], ...]
    values: np.ndarray
    frame_time: float

    def angles(self, joint: int) -> list[tuple[str, np.ndarray]]:
        """Rotations of a joint in the order in which they are applied from the left: (axis, degrees [T])."""
        return [(c[0], self.values[:, i]) for i, c in self._columns(joint) if c.endswith("rotation")]

    def position(self, joint: int) -> np.ndarray:
        """[T,3] the joint's place relative to its parent: its offset, or its position channels where it has them."""
        place = np.tile(np.asarray(self.joints[joint].offset), (len(self.values), 1))
        for column, channel in self._columns(joint):
            if channel.endswith("position"):
                place[:, "XYZ".index(channel[0])] = self.values[:, column]
        return place

    def _columns(self, joint: int) -> list[tuple[int, str]]:
        start = sum(len(other.channels) for other in self.joints[:joint])
        return [(start + i, channel) for i, channel in enumerate(self.joints[joint].channels)]


def read_bvh(path: str | Path) -> Bvh:
    """Read a `.bvh` file.

    Raises:
        FileNotFoundError: No such file.
        BvhError: Malformed, cut off, or a frame has too few numbers.
    """
    source = Path(path)
    text = source.read_text(encoding="utf-8", errors="replace")
    head, _, tail = text.partition("MOTION")
    if not head.lstrip().startswith("HIERARCHY") or not tail:
        raise BvhError(f"expected HIERARCHY and MOTION in {source.name!r}, got neither or only one: is it cut off?")
    words = iter(head.split())
    try:
        next(words)
        joints, ends = _hierarchy(words)
    except (StopIteration, RuntimeError, ValueError) as error:
        raise BvhError(
            f"expected a complete HIERARCHY in {source.name!r}, got {error or 'its end too soon'}"
        ) from error
    return Bvh(tuple(joints), tuple(ends), *_motion(tail, sum(len(j.channels) for j in joints), source.name))


def _hierarchy(words: Iterator[str]) -> tuple[list[BvhJoint], list[tuple[int, tuple[float, float, float]]]]:
    joints: list[BvhJoint] = []
    ends: list[tuple[int, tuple[float, float, float]]] = []
    stack: list[int] = []  # numbers of the open joints; -2 - j for an end site of joint j
    for word in words:
        match word:
            case "ROOT" | "JOINT":
                if word == "ROOT" and joints:
                    raise ValueError("a second ROOT; split the file, one person each")
                joints.append(BvhJoint(next(words), stack[-1] if stack else -1, (0.0, 0.0, 0.0), ()))
                stack.append(len(joints) - 1)
                _expect(words, "{")
            case "End":
                _expect(words, "Site")
                _expect(words, "{")
                stack.append(-2 - stack[-1])
            case "OFFSET":
                offset = (float(next(words)), float(next(words)), float(next(words)))
                if stack[-1] < 0:
                    ends.append((-2 - stack[-1], offset))
                else:
                    old = joints[stack[-1]]
                    joints[stack[-1]] = BvhJoint(old.name, old.parent, offset, old.channels)
            case "CHANNELS":
                channels = tuple(next(words) for _ in range(int(next(words))))
                unknown = set(channels) - set(_CHANNELS)
                if unknown:
                    raise ValueError(f"the unknown channels {sorted(unknown)}")
                old = joints[stack[-1]]
                joints[stack[-1]] = BvhJoint(old.name, old.parent, old.offset, channels)
            case "}":
                stack.pop()
            case _:
                raise ValueError(f"the word {word[:40]!r}")
        if len(joints) > _MAX_JOINTS:
            raise ValueError(f"more than {_MAX_JOINTS} joints")
    if stack or not joints:
        raise ValueError("an end in the middle of a joint")
    return joints, ends


def _expect(words: Iterator[str], word: str) -> None:
    found = next(words)
    if found != word:
        raise ValueError(f"{found[:40]!r} where {word!r} belongs")


def _motion(text: str, channels: int, name: str) -> tuple[np.ndarray, float]:
    lines = text.strip().splitlines()
    try:
        frames = int(lines[0].split(":")[1])
        frame_time = float(lines[1].split(":")[1])
        numbers = np.array(" ".join(lines[2:]).split(), dtype=np.float64)
    except (IndexError, ValueError) as error:
        raise BvhError(f"expected 'Frames:', 'Frame Time:' and numbers in {name!r}, got {error}") from error
    if frames < 1 or not (math.isfinite(frame_time) and frame_time > 0):
        raise BvhError(f"expected frames and a positive frame time in {name!r}, got {frames} and {frame_time}")
    if len(numbers) != frames * channels:
        raise BvhError(
            f"expected {frames} frames of {channels} numbers in {name!r}, got {len(numbers)} numbers: is it cut off?"
        )
    return numbers.reshape(frames, channels), frame_time
