"""A capture as the stages take it: its clip as arrays, and the fit that perception would give if it made no error."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from ahoy_core.body.packaged import PackagedBody
from ahoy_core.captures.capture import Capture, Moment, View, drive
from ahoy_core.captures.files import read_mask
from ahoy_core.formats.video import read_frames

Fit = Mapping[str, NDArray[np.generic]]
"""Arrays of the perceive stage's body.npz, by name."""


@dataclass(frozen=True)
class Clip:
    """The input of T frames.

    Attributes:
        frames: [T,H,W,3] uint8 sRGB.
        visible: [T,H,W] uint8 alpha of what the camera sees of the person.
        times: [T] seconds.
    """

    frames: NDArray[np.uint8]
    visible: NDArray[np.uint8]
    times: NDArray[np.float64]

    def first(self, count: int) -> Clip:
        """The same clip, cut off after `count` frames."""
        return replace(self, frames=self.frames[:count], visible=self.visible[:count], times=self.times[:count])


def read_clip(capture: Capture) -> Clip:
    """Decode the input of one of our captures, with its true masks.

    Raises:
        ValueError: the layout has no masks of every frame, or one is missing or of another size than the video.
    """
    if capture.kind != "ours" or capture.video is None:
        raise ValueError(f"expected a capture of this project's layout, got {capture.name}, which is {capture.kind}")
    frames = np.stack([frame.image for frame in read_frames(capture.video)])
    visible = np.stack([read_mask(capture.folder / "vis" / f"{t:03d}.png") for t in range(len(frames))])
    if visible.shape != frames.shape[:3]:
        raise ValueError(f"expected masks {frames.shape[:3]} in {capture.folder / 'vis'}, got {visible.shape}")
    return Clip(frames, visible, np.arange(len(frames)) / capture.fps)


def true_fit(capture: Capture, body: PackagedBody, moment: Moment = "view") -> Fit:
    """What the perceive stage's body.npz would hold if it made no error; the world is the capture's.

    Args:
        capture: with a true body of that moment in its own shape.
        body: the packaged one.
        moment: "view" for the input, "pose" for the unseen motion.
    """
    truth = capture.bodies[moment]
    betas = (body.default_betas if truth.betas is None else truth.betas).float()
    pose, transl = drive(truth, body, betas)
    camera, count = capture.cameras[capture.input_camera], len(pose)
    return {
        "pose": pose.numpy(),
        "transl": transl.numpy(),
        "betas": betas.numpy(),
        "expression": np.zeros((count, body.n_expressions), dtype=np.float32),
        "joint_confidence": np.ones((count, body.n_joints), dtype=np.float32),
        "frame_confidence": np.ones(count, dtype=np.float32),
        "used": np.ones(count, dtype=bool),
        "viewmat": camera.viewmats[0].numpy(),
        "K": camera.Ks[0].numpy(),
    }


def posed_vertices(body: PackagedBody, fit: Fit, frame: int) -> NDArray[np.float32]:
    """Vertices [V,3] of a fit in one frame, metres, world."""
    pose, transl, betas = (torch.from_numpy(fit[name]) for name in ("pose", "transl", "betas"))
    with torch.no_grad():
        output = body(pose[frame, None], betas[None], transl[frame, None])
    return np.asarray(output.vertices[0].numpy(), dtype=np.float32)


def true_frames(capture: Capture) -> list[int]:
    """Numbers of the input's frames with a true picture of the whole person before its camera, in order."""
    return sorted(view.frame for view in capture.of("view") if view.camera == capture.input_camera)


def true_rgba(capture: Capture, view: View) -> NDArray[np.float32]:
    """A true picture [H,W,4] in levels 0 to 255, straight alpha."""
    picture = capture.picture(view)
    both = torch.cat([picture.rgb, picture.alpha[None]]).permute(1, 2, 0) * 255
    return np.asarray(both.round().numpy(), dtype=np.float32)
