"""What perception found in a capture's input, as scoring needs it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ahoy_core.body.convert import joint_map
from ahoy_core.body.model import BodyModel
from ahoy_core.body.packaged import load_packaged_body
from ahoy_core.captures.capture import BodyTruth, TruePicture, true_joints
from ahoy_core.captures.files import unit
from ahoy_core.conventions import Cameras
from ahoy_core.formats.npz import load_npz
from ahoy_core.metrics.alignment import Similarity, fit_similarity


@dataclass(frozen=True)
class Fitted:
    """Of T frames that were read.

    Attributes:
        frames: [T,H,W,3] uint8.
        index: [T] number of each in the input.
        used: [T] bool, a body was fitted.
        visible: [T,H,W] uint8 alpha of the visible part of the person.
        pose: [T,J,3] axis-angle.
        transl: [T,3] metres.
        betas: [S].
        camera: the fitted one.
    """

    frames: np.ndarray
    index: np.ndarray
    used: np.ndarray
    visible: np.ndarray
    pose: Tensor
    transl: Tensor
    betas: Tensor
    camera: Cameras

    @classmethod
    def read(cls, ingest: Path, perceive: Path) -> Fitted:
        """From the artifact folders of these stages."""
        video, fit = load_npz(ingest / "frames.npz"), load_npz(perceive / "body.npz")
        height, width = video["frames"].shape[1:3]
        viewmat, K = torch.from_numpy(fit["viewmat"])[None], torch.from_numpy(fit["K"])[None]
        pose, transl, betas = (torch.from_numpy(fit[name]).float() for name in ("pose", "transl", "betas"))
        visible = load_npz(perceive / "masks.npz", ["visible"])["visible"]
        camera = Cameras(viewmat, K, width, height, "pinhole")
        return cls(video["frames"], video["index"], fit["used"], visible, pose, transl, betas, camera)

    def row(self, frame: int) -> int | None:
        """Row of a frame of the input; None where it was not read or nobody was fitted."""
        rows = np.flatnonzero((self.index == frame) & self.used)
        return int(rows[0]) if len(rows) else None

    def picture(self, frame: int) -> TruePicture:
        """The input's own frame as truth, with the mask that perception found."""
        row = self.row(frame)
        if row is None:
            raise ValueError(f"expected a fitted frame, got {frame}; leave it out")
        alpha = unit(self.visible[row])
        return TruePicture(unit(self.frames[row]), alpha, torch.ones_like(alpha, dtype=torch.bool))

    def alignment(self, truth: BodyTruth, body: BodyModel) -> Similarity:
        """The one similarity that takes the fitted joints of all frames to the true ones.

        Raises:
            ValueError: fitted and true joints have no frame in common.
        """
        pairs = [(row, truth.row(f)) for f in truth.frames if (row := self.row(f)) is not None]
        if not pairs:
            raise ValueError("expected a fitted frame with a true body, got none; leave novel-view-est out")
        rows, numbers = (list(column) for column in zip(*pairs, strict=True))
        with torch.no_grad():
            found = body(self.pose[rows], self.betas[None], self.transl[rows]).joints
        true = true_joints(truth)[numbers]
        here, there = _common(body)
        return fit_similarity(found[:, here].reshape(-1, 3), true[:, there].reshape(-1, 3))


def _common(body: BodyModel) -> tuple[list[int], list[int]]:
    """Joints of a body and of the packaged one that correspond."""
    packaged = load_packaged_body()
    names = joint_map(body.joint_names, packaged.joint_names) or {name: name for name in body.joint_names}
    pairs = [(body.joint_names.index(mine), packaged.joint_names.index(theirs)) for mine, theirs in names.items()]
    return [mine for mine, _ in pairs], [theirs for _, theirs in pairs]
