"""Reader of captures whose truth is known; their README says how a folder is laid out.

The front video and the masks of what it shows are input; the pictures of four cameras and the true body are the truth.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import av
import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from ahoy_core.body.convert import from_local_ref
from ahoy_core.body.packaged import PackagedBody
from ahoy_core.conventions import Cameras

# The captures' 24 joints (SMPL's order) and the joint of the packaged body at the same place; `breast.L` and spine01
# start where spine3 is.
JOINTS24 = {
    "pelvis": "root", "l_hip": "upperleg01.L", "r_hip": "upperleg01.R", "spine1": "spine04", "l_knee": "lowerleg01.L",
    "r_knee": "lowerleg01.R", "spine2": "spine02", "l_ankle": "foot.L", "r_ankle": "foot.R", "spine3": "breast.L",
    "l_foot": "toe1-1.L", "r_foot": "toe1-1.R", "neck": "neck01", "l_collar": "clavicle.L", "r_collar": "clavicle.R",
    "head": "head", "l_shoulder": "upperarm01.L", "r_shoulder": "upperarm01.R", "l_elbow": "lowerarm01.L",
    "r_elbow": "lowerarm01.R",
    "l_wrist": "wrist.L", "r_wrist": "wrist.R", "l_hand": "finger3-1.L", "r_hand": "finger3-1.R",
}  # fmt: skip


@dataclass(frozen=True)
class Capture:
    """One capture of T frames.

    Attributes:
        folder: where it lies; its name is the capture's.
        frames: [T,H,W,3] uint8 sRGB, the front camera's video.
        visible: [T,H,W] uint8 alpha of what that camera sees of the person.
        cameras: by name, one camera each, world -> camera as in `ahoy_core.conventions`.
    """

    folder: Path
    frames: NDArray[np.uint8]
    visible: NDArray[np.uint8]
    cameras: Mapping[str, Cameras]

    def first(self, count: int) -> Capture:
        """The same capture, cut off after `count` frames."""
        return replace(self, frames=self.frames[:count], visible=self.visible[:count])

    def scored_frames(self) -> list[int]:
        """Numbers of the frames with a true picture from the front camera, in order."""
        return sorted(int(path.stem.rpartition("_")[2]) for path in (self.folder / "gt").glob("front_*.png"))

    def truth(self, camera: str, frame: int, kind: str = "gt") -> NDArray[np.uint8]:
        """True picture [H,W,4] of the person alone: RGBA uint8, straight alpha; `kind` "novel" is the unseen motion."""
        image = _read_png(self.folder / kind / f"{camera}_{frame:03d}.png")
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGRA2RGBA), dtype=np.uint8)


def capture_folders(root: Path) -> list[Path]:
    """Folders of the captures below `root`, by name.

    Raises:
        ValueError: if there is none.
    """
    found = sorted(path.parent for path in root.glob("*/cameras.json"))
    if not found:
        raise ValueError(f"expected captures (folders with cameras.json) in {root}, got none; give their common folder")
    return found


def read_capture(folder: Path) -> Capture:
    """Decode the video and its masks, and read the cameras.

    Raises:
        ValueError: a mask is missing or has another size than the video.
    """
    with av.open(str(folder / "front.mp4")) as video:
        frames = np.stack([frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)])
    masks = [_read_png(folder / "vis" / f"{t:03d}.png") for t in range(len(frames))]
    visible = np.stack([mask if mask.ndim == 2 else mask[..., -1] for mask in masks])
    if visible.shape != frames.shape[:3]:
        raise ValueError(f"expected masks {frames.shape[:3]} in {folder / 'vis'}, got {visible.shape}")
    cameras = json.loads((folder / "cameras.json").read_text(encoding="utf-8"))["cameras"]
    return Capture(
        folder,
        frames.astype(np.uint8, copy=False),
        visible,
        {name: _camera(camera) for name, camera in cameras.items()},
    )


def true_fit(capture: Capture, body: PackagedBody, motion_file: str = "motion.npz") -> dict[str, NDArray[np.generic]]:
    """What the perceive stage's body.npz would hold if it made no error; the world is the capture's."""
    motion = np.load(capture.folder / motion_file)
    phenotype = json.loads(str(motion["phenotype"]))
    betas = torch.tensor([phenotype[name] for name in body.beta_names])
    pose, transl = from_local_ref(body, torch.from_numpy(motion["pose_local_ref"]), betas)
    front, count = capture.cameras["front"], len(pose)
    return {
        "pose": pose.float().numpy(),
        "transl": transl.float().numpy(),
        "betas": betas.float().numpy(),
        "expression": np.zeros((count, body.n_expressions), dtype=np.float32),
        "joint_confidence": np.ones((count, body.n_joints), dtype=np.float32),
        "frame_confidence": np.ones(count, dtype=np.float32),
        "used": np.ones(count, dtype=bool),
        "viewmat": front.viewmats[0].numpy(),
        "K": front.Ks[0].numpy(),
    }


def posed_vertices(body: PackagedBody, fit: Mapping[str, NDArray[np.generic]], frame: int) -> NDArray[np.float32]:
    """Vertices [V,3] of a fit in one frame, metres, world."""
    pose, transl, betas = (torch.from_numpy(fit[name]) for name in ("pose", "transl", "betas"))
    with torch.no_grad():
        output = body(pose[frame, None], betas[None], transl[frame, None])
    return np.asarray(output.vertices[0].numpy(), dtype=np.float32)


def _camera(fields: Mapping[str, object]) -> Cameras:
    viewmat = torch.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = torch.tensor(fields["R"]), torch.tensor(fields["t"])
    K = torch.tensor(fields["K"]).float()
    return Cameras(viewmat[None], K[None], int(str(fields["width"])), int(str(fields["height"])), "pinhole")


def _read_png(path: Path) -> NDArray[np.uint8]:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise ValueError(f"expected a picture at {path}, got none that can be read; is the capture complete?")
    return np.asarray(image, dtype=np.uint8)
