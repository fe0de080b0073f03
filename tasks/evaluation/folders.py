"""Renders that another system made, dropped into a folder, as a renderer: the same code scores them."""

from __future__ import annotations

import hashlib
from pathlib import Path

import torch

from ahoy_core.captures.capture import Capture
from ahoy_core.captures.files import read_picture, unit
from ahoy_core.conventions import GREY
from ahoy_core.metrics.score import Made
from storage_schema.keys import file_sha256
from tasks.evaluation.fitted import Fitted
from tasks.evaluation.truths import Shot
from tasks.stage import Source, StageContext


def renders_source(folder: Path, capture: str) -> Source:
    """One capture's renders, known by their contents.

    Args:
        folder: holds `CAPTURE/PROTOCOL/CAMERA_NNN.png`.
        capture: its name.

    Raises:
        ValueError: there are none.
    """
    home = folder / capture
    files = sorted(home.glob("*/*.png"))
    if not files:
        raise ValueError(f"expected renders as {home}/PROTOCOL/CAMERA_NNN.png, got none; docs/metrics.md says how")
    listed = "\n".join(f"{path.relative_to(home)} {file_sha256(path)}" for path in files)
    return Source(home, hashlib.sha256(listed.encode()).hexdigest(), capture)


class FolderRenderer:
    """PNG files of one capture: RGBA with straight alpha, or RGB over grey 0.5 (then without IoU).

    Args:
        folder: holds `PROTOCOL/CAMERA_NNN.png`, each of the size that is scored.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def __call__(self, shot: Shot) -> Made | None:
        """Read one picture; None where there is none.

        Raises:
            ValueError: it has another size than its truth.
        """
        path = self._folder / shot.protocol / f"{shot.view.camera}_{shot.view.frame:03d}.png"
        if not path.is_file():
            return None
        image = unit(read_picture(path))
        image = image.expand(3, -1, -1) if image.ndim == 2 else image
        if image.shape[1:] != shot.truth.alpha.shape:
            wanted = f"{shot.truth.alpha.shape[1]}x{shot.truth.alpha.shape[0]}"
            raise ValueError(f"expected {wanted} pixels in {path}, got {image.shape[2]}x{image.shape[1]}; render at it")
        if len(image) == 3:
            return Made(image, None)
        return Made(image[:3] * image[3] + GREY * (1 - image[3]), torch.as_tensor(image[3]))


def folder_renderer(ctx: StageContext, capture: Capture, fitted: Fitted) -> FolderRenderer:
    """The renderer of the stage's input `renders`."""
    return FolderRenderer(ctx.inputs["renders"])
