"""A capture as inputs of stages: its video, its contents as a hash, and what its interface tells the method."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np

from ahoy_core.captures.capture import Capture
from ahoy_core.formats.video_write import write_mp4
from ahoy_core.perceive.config import KnownCamera
from storage_schema.keys import file_sha256
from tasks.stage import Source

CRF = 8  # of an input that is written from pictures: well below the noise of its source


def truth_source(capture: Capture) -> Source:
    """The capture, known by everything that scores depend on: its files, cameras and true bodies."""
    digest = hashlib.sha256()
    files = [capture.folder] if capture.folder.is_file() else sorted(capture.folder.rglob("*"))
    for path in files:
        if path.is_file():
            digest.update(f"{path.name if path == capture.folder else path.relative_to(capture.folder)}\n".encode())
            digest.update(file_sha256(path).encode())
    for name, camera in sorted(capture.cameras.items()):
        digest.update(name.encode() + camera.viewmats.numpy().tobytes() + camera.Ks.numpy().tobytes())
    for name, body in sorted(capture.bodies.items()):
        digest.update(name.encode() + body.pose.rotations.numpy().tobytes() + body.pose.root.numpy().tobytes())
        digest.update(np.asarray(body.frames, dtype=np.int64).tobytes())
    return Source(capture.folder, digest.hexdigest(), capture.name)


def video_source(capture: Capture, content_hash: str, folder: Path) -> Source:
    """The input as a video file; written from its pictures where the capture has none.

    Args:
        capture: whose input.
        content_hash: of the capture, for the name of a written file.
        folder: where such a file goes; one that is there is used again.
    """
    path = capture.video
    if path is None:
        path = folder / f"{capture.name}-{content_hash[:12]}.mp4"
        if not path.is_file():
            assert capture.frames is not None
            path.parent.mkdir(parents=True, exist_ok=True)
            write_mp4(path, capture.frames(), capture.fps, crf=CRF)
    return Source(path, file_sha256(path), capture.name, capture.name)


def known_camera(capture: Capture) -> KnownCamera | None:
    """The input's camera as the method may be told; None where it is not known."""
    camera = capture.cameras.get(capture.input_camera)
    if camera is None:
        return None
    stands = tuple(map(float, camera.viewmats[0].flatten())) if capture.stands else None
    return KnownCamera(K=tuple(map(float, camera.Ks[0].flatten())), viewmat=stands, width=camera.width)
