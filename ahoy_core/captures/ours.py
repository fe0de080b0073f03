"""Reader of this project's own captures: `front.mp4`, `vis/`, `gt/`, `novel/`, `cameras.json`, `motion.npz`."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from ahoy_core.body.convert import SkeletonPose, rig_skeleton
from ahoy_core.body.packaged import load_packaged_body
from ahoy_core.body.rotations import nearest_rotation
from ahoy_core.captures.capture import BodyTruth, Capture, Moment, TruePicture, View
from ahoy_core.captures.files import camera, read_json, read_mask, read_picture, unit
from ahoy_core.conventions import Cameras
from ahoy_core.formats.npz import load_npz
from ahoy_core.formats.video import read_frames

INPUT = "front"
_FOLDERS: dict[Moment, str] = {"view": "gt", "pose": "novel"}


def is_ours(folder: Path) -> bool:
    """Whether a folder has this layout."""
    return (folder / "cameras.json").is_file() and (folder / "front.mp4").is_file()


def read_cameras(folder: Path) -> dict[str, Cameras]:
    """The cameras of `cameras.json`, by name."""
    fields = read_json(folder / "cameras.json")["cameras"]
    return {
        name: camera(one["K"], one["R"], one["t"], int(one["width"]), int(one["height"]))
        for name, one in fields.items()
    }


def read_ours(folder: Path) -> Capture:
    """Read a capture; pictures are loaded when they are asked for.

    Raises:
        ValueError: a file is missing or damaged.
    """
    cameras = read_cameras(folder)
    views = [
        View(moment, path.stem.rpartition("_")[0], int(path.stem.rpartition("_")[2]))
        for moment, name in _FOLDERS.items()
        for path in sorted((folder / name).glob("*_*.png"))
    ]
    if unknown := sorted({view.camera for view in views} - set(cameras)):
        raise ValueError(f"expected pictures of the cameras {sorted(cameras)} in {folder}, got some of {unknown}")
    seen = sorted({view.frame for view in views if view.moment == "view"})
    inputs = [View("input", INPUT, frame) for frame in seen if (folder / "vis" / f"{frame:03d}.png").is_file()]
    found: list[NDArray[np.uint8]] = []

    def frames() -> list[NDArray[np.uint8]]:
        if not found:
            found.extend(frame.image for frame in read_frames(folder / "front.mp4"))
        return found

    def picture(view: View) -> TruePicture:
        if view.moment == "input":
            rgb, alpha = unit(frames()[view.frame]), unit(read_mask(folder / "vis" / f"{view.frame:03d}.png"))
            return TruePicture(rgb, alpha, torch.ones_like(alpha, dtype=torch.bool))
        rgba = unit(read_picture(folder / _FOLDERS[view.moment] / f"{view.camera}_{view.frame:03d}.png"))
        return TruePicture(rgba[:3], rgba[3], torch.ones_like(rgba[3], dtype=torch.bool))

    names: dict[str, str] = {"view": "motion.npz", "pose": "novel_motion.npz"}
    return Capture(
        name=folder.name,
        folder=folder,
        kind="ours",
        views=(*views, *inputs),
        picture=picture,
        video=folder / "front.mp4",
        input_camera=INPUT,
        cameras=cameras,
        bodies={moment: read_motion(folder / name) for moment, name in names.items() if (folder / name).is_file()},
        stands=True,
    )


def read_motion(path: Path) -> BodyTruth:
    """The true body of `motion.npz`.

    Raises:
        ValueError: poses of another rig than the packaged body's.
    """
    body = load_packaged_body()
    arrays = load_npz(path, ["pose_local_ref", "phenotype"])
    phenotype = json.loads(str(arrays["phenotype"]))
    local = torch.from_numpy(arrays["pose_local_ref"]).double()
    if local.ndim != 4 or local.shape[1:] != (len(body.rig_names), 4, 4):
        raise ValueError(f"expected pose_local_ref [T,{len(body.rig_names)},4,4] in {path}, got {tuple(local.shape)}")
    pose = SkeletonPose(nearest_rotation(local[..., :3, :3]), local[:, 0, :3, 3])
    betas = torch.tensor([float(phenotype[name]) for name in body.beta_names])
    return BodyTruth(rig_skeleton(body), pose, tuple(range(len(local))), betas)
