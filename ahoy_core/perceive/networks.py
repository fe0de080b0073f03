"""The TFLite networks of BlazePose and its face mesh, as functions of arrays.

Bazarevsky et al., "BlazePose: On-device Real-time Body Pose tracking" (2020); GHUM-trained 3D variant: Grishchenko et
al. (2022).
"""

from __future__ import annotations

import contextlib
import os
import sys
import tempfile
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

DETECTOR_SIZE = 224
LANDMARKER_SIZE = 256
FACE_SIZE = 192
N_FACE = 468
N_LANDMARKS = 33
N_RAW = 39  # 33 landmarks of the body and six that only steer the crop of the next frame
STDERR = 2  # the descriptor
_STDERR = threading.Lock()
BANNER = b"INFO: Created TensorFlow Lite XNNPACK delegate for CPU."
Landmarker = Literal[
    "pose_landmark_lite", "pose_landmark_full", "pose_landmark_heavy", "pose_landmark_full+pose_landmark_heavy"
]
FULL: Final[Landmarker] = "pose_landmark_full"


def files_of(landmarker: Landmarker) -> tuple[str, ...]:
    """Names of the networks that are needed: the detector's, one or two of landmarks, the face's."""
    return ("pose_detection", *landmarker.split("+"), "face_landmark")


@dataclass(frozen=True)
class RawLandmarks:
    """What the landmark network says about one crop.

    Attributes:
        points: [39,3] x, y, z in crop pixels (of 256); z relative to the hips, negative towards the camera.
        visibility: [39] in [0,1].
        presence: [39] in [0,1]: inside the crop.
        world: [39,3] metres, hips at the origin, x right, y down, z away from the camera.
        score: [0,1]: a person is in the crop.
        mask: [256,256] in [0,1].
        heatmap: [64,64,39] logits.
    """

    points: NDArray[np.float32]
    visibility: NDArray[np.float32]
    presence: NDArray[np.float32]
    world: NDArray[np.float32]
    score: float
    mask: NDArray[np.float32]
    heatmap: NDArray[np.float32]


@contextlib.contextmanager
def _without_banner() -> Iterator[None]:
    """Hold back what is written to the process's stderr, and pass on all of it but the library's `BANNER`.

    The native library writes to the descriptor itself and offers no switch, in its environment or its interface.
    """
    sys.stderr.flush()
    with _STDERR, tempfile.TemporaryFile() as held:
        try:
            kept = os.dup(STDERR)
        except OSError:  # stderr is closed: there is nothing to hold back
            yield
            return
        os.dup2(held.fileno(), STDERR)
        try:
            yield
        finally:
            sys.stderr.flush()
            os.dup2(kept, STDERR)
            os.close(kept)
            held.seek(0)
            for line in held:
                if not line.startswith(BANNER):
                    os.write(STDERR, line)


class _Network:
    """One interpreter behind a lock: TFLite's buffers belong to one caller at a time."""

    def __init__(self, path: Path, num_threads: int) -> None:
        from ai_edge_litert.interpreter import Interpreter

        with _without_banner():
            self._interpreter = Interpreter(model_path=str(path), num_threads=num_threads)
            self._interpreter.allocate_tensors()
        self._input = self._interpreter.get_input_details()[0]["index"]
        self._outputs = {d["name"]: d["index"] for d in self._interpreter.get_output_details()}
        self._lock = threading.Lock()

    def __call__(self, image: NDArray[np.float32]) -> dict[str, NDArray[np.float32]]:
        with self._lock:
            self._interpreter.set_tensor(self._input, np.ascontiguousarray(image[None], dtype=np.float32))
            self._interpreter.invoke()
            return {name: self._interpreter.get_tensor(index)[0].copy() for name, index in self._outputs.items()}


class Networks:
    """Detector, landmark and face network, loaded from files.

    Args:
        paths: file of each network in `files_of(landmarker)`, by name.
        num_threads: threads of each interpreter.
        landmarker: which landmark network; of two, the mean of what they say, with the first one's mask (the heavy
            network's is worse).

    Raises:
        ValueError: a network is not among `paths`, or `num_threads` is below 1.
    """

    def __init__(self, paths: Mapping[str, Path], num_threads: int = 1, landmarker: Landmarker = FULL) -> None:
        names = files_of(landmarker)
        missing = [name for name in names if name not in paths]
        if missing:
            raise ValueError(f"expected the files of {', '.join(names)}, got none for {', '.join(missing)}")
        if num_threads < 1:
            raise ValueError(f"expected num_threads of at least 1, got {num_threads}")
        self._detector: Any = _Network(paths["pose_detection"], num_threads)
        self._landmarkers: list[Any] = [_Network(paths[name], num_threads) for name in landmarker.split("+")]
        self._face: Any = _Network(paths["face_landmark"], num_threads)

    def detect(self, image: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Run the detector.

        Args:
            image: [224,224,3] sRGB in [0,1].

        Returns:
            Box regressions [2254,12] in input pixels relative to their anchors, and score logits [2254].
        """
        out = self._detector(image * 2.0 - 1.0)
        return out["Identity"], out["Identity_1"][:, 0]

    def landmarks(self, image: NDArray[np.float32]) -> RawLandmarks:
        """Run the landmark network on one upright crop, [256,256,3] sRGB in [0,1]."""
        return _mean([_raw(network(image)) for network in self._landmarkers])

    def face(self, image: NDArray[np.float32]) -> tuple[NDArray[np.float32], float]:
        """Run the face network on one upright crop, [192,192,3] sRGB in [0,1].

        Returns:
            Landmarks [468,3] in crop pixels (z negative towards the camera), and a score in [0,1]: a face is there.
        """
        points, score = sorted(self._face(image).values(), key=lambda values: -values.size)
        return points.reshape(N_FACE, 3), float(sigmoid(score.reshape(-1))[0])


def _raw(out: Mapping[str, NDArray[np.float32]]) -> RawLandmarks:
    rows = out["Identity"].reshape(N_RAW, 5)
    return RawLandmarks(
        points=rows[:, :3],
        visibility=sigmoid(rows[:, 3]),
        presence=sigmoid(rows[:, 4]),
        world=out["Identity_4"].reshape(N_RAW, 3),
        score=float(out["Identity_1"][0]),
        mask=sigmoid(out["Identity_2"][..., 0]),
        heatmap=out["Identity_3"],
    )


def _mean(answers: Sequence[RawLandmarks]) -> RawLandmarks:
    """Field by field, with the first answer's mask."""
    if len(answers) == 1:
        return answers[0]
    means: dict[str, Any] = {
        each.name: np.mean([getattr(answer, each.name) for answer in answers], axis=0, dtype=np.float32)
        for each in fields(RawLandmarks)
        if each.name not in ("score", "mask")
    }
    return RawLandmarks(**means, score=float(np.mean([a.score for a in answers])), mask=answers[0].mask)


def sigmoid(x: NDArray[np.float32]) -> NDArray[np.float32]:
    """Logistic function, without overflow."""
    return np.asarray(0.5 * (1.0 + np.tanh(0.5 * x)), dtype=np.float32)
