"""Tiny data sets in the true layouts: names, nesting and conventions are theirs, every number is ours."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import torch

from ahoy_core.body.convert import to_local_ref
from ahoy_core.body.packaged import load_packaged_body
from ahoy_core.formats.video_write import write_mp4

HEIGHT, WIDTH, COUNT = 48, 64, 4
K = np.array([[60.0, 0, 32], [0, 60.0, 24], [0, 0, 1]])
# Looks along +y from 3 m before the origin, 1 m above the floor: x_cam = x, y_cam = 1 - z, z_cam = y + 3.
LOOKS_ALONG_Y = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
PERSON = (slice(12, 36), slice(24, 40))


def person_mask(hidden_rows: int = 0) -> np.ndarray:
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[PERSON] = 255
    mask[36 - hidden_rows : 36] = 0
    return mask


def picture(shade: int) -> np.ndarray:
    image = np.full((HEIGHT, WIDTH, 3), 40, np.uint8)
    image[PERSON] = (shade, 100, 20)
    return image


def write_rgb(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image if image.ndim == 2 else image[..., [2, 1, 0, *range(3, image.shape[2])]])


def ours(root: Path, name: str = "c") -> Path:
    """This project's layout: two cameras, `COUNT` frames of which 0 and 2 have truth, and two of an unseen motion."""
    body, home = load_packaged_body(), root / name
    home.mkdir(parents=True)
    write_mp4(home / "front.mp4", np.stack([picture(200)] * COUNT), fps=15)
    for t in range(COUNT):
        write_rgb(home / "vis" / f"{t:03d}.png", person_mask(hidden_rows=8))
    for folder, frames in (("gt", (0, 2)), ("novel", (0, 1))):
        for camera in ("front", "back"):
            for t in frames:
                rgba = np.concatenate([picture(150 + t), person_mask()[..., None]], -1)
                write_rgb(home / folder / f"{camera}_{t:03d}.png", rgba)
    turned = np.diag([-1.0, 1, -1]) @ LOOKS_ALONG_Y
    cameras = {
        "front": {"K": K.tolist(), "R": LOOKS_ALONG_Y.tolist(), "t": [0, 1, 3], "width": WIDTH, "height": HEIGHT},
        "back": {"K": K.tolist(), "R": turned.tolist(), "t": [0, 1, 3], "width": WIDTH, "height": HEIGHT},
    }
    (home / "cameras.json").write_text(json.dumps({"cameras": cameras}), encoding="utf-8")
    phenotype = dict(zip(body.beta_names, body.default_betas.tolist(), strict=True))
    for file, count in (("motion.npz", COUNT), ("novel_motion.npz", 2)):
        pose = torch.zeros(count, body.n_joints, 3)
        pose[:, 0, 2] = 0.1 * torch.arange(count)
        local = to_local_ref(body, pose, torch.tensor([[0.1, 0.2, 0.0]]).expand(count, 3), body.default_betas)
        np.savez(home / file, pose_local_ref=local.numpy(), phenotype=json.dumps(phenotype))
    return home


# The person of both SMPL layouts: SMPL's pelvis stands here in the data set's world.
PELVIS_WORLD = np.array([0.2, 0.1, 2.5])


def behave(root: Path, frames: int = 4) -> Path:
    """BEHAVE: camera 1 is the world (y down, z forward); camera 2 stands half a metre to its right."""
    sequence = root / "sequences" / "Date01_Sub01_box"
    config, intrinsics = root / "calibs" / "Date01" / "config", root / "calibs" / "intrinsics"
    for k, shift in ((1, 0.0), (2, 0.5)):
        for place in (config / str(k), intrinsics / str(k)):
            place.mkdir(parents=True)
        pose = {"rotation": np.eye(3).ravel().tolist(), "translation": [shift, 0.0, 0.0]}
        (config / str(k) / "config.json").write_text(json.dumps(pose))
        colour = {"fx": 60.0, "fy": 60.0, "cx": 31.5, "cy": 23.5, "width": WIDTH, "height": HEIGHT}
        colour["opencv"] = [60.0, 60.0, 31.5, 23.5, 0, 0, 0, 0, 0, 0, 0, 0]
        (intrinsics / str(k) / "calibration.json").write_text(json.dumps({"color": colour, "depth": {}}))
    times = [f"t{t:04d}.000" for t in range(frames)]
    for t, name in enumerate(times):
        for k in (1, 2):
            write_rgb(sequence / name / f"k{k}.color.jpg", picture(100 + 20 * t))
            write_rgb(sequence / name / f"k{k}.person_mask.jpg", person_mask(hidden_rows=8))
            hidden = np.zeros((HEIGHT, WIDTH), np.uint8)
            hidden[28:40, 20:44] = 255
            write_rgb(sequence / name / f"k{k}.obj_rend_mask.jpg", hidden)
    info = {"config": "../../calibs/Date01/config", "intrinsic": "../../calibs/intrinsics", "cat": "box"}
    (sequence / "info.json").write_text(json.dumps({**info, "gender": "male", "empty": None, "kinects": [1, 2]}))
    poses = np.zeros((frames, 156))
    poses[:, 0] = np.pi  # upright in a world whose y is down
    from ahoy_core.motion.smpl import SMPL_PELVIS

    trans = np.tile(PELVIS_WORLD - np.array(SMPL_PELVIS), (frames, 1))
    np.savez(
        sequence / "smpl_fit_all.npz", poses=poses, betas=np.zeros((frames, 10)), trans=trans,
        frame_times=np.array(times),
    )  # fmt: skip
    return root


def multiview(root: Path, frames: int = 4, as_json: bool = False) -> Path:
    """EasyMocap's layout, cameras in a z-up world."""
    home = root / "seq"
    home.mkdir(parents=True)
    intri = cv2.FileStorage(str(home / "intri.yml"), cv2.FILE_STORAGE_WRITE)
    extri = cv2.FileStorage(str(home / "extri.yml"), cv2.FILE_STORAGE_WRITE)
    for name, shift in (("01", 0.0), ("02", 0.5)):
        intri.write(f"K_{name}", K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]))
        intri.write(f"dist_{name}", np.zeros((1, 5)))
        extri.write(f"Rot_{name}", LOOKS_ALONG_Y)
        extri.write(f"T_{name}", np.array([[-shift], [1.0], [3.0]]))
        for t in range(frames):
            write_rgb(home / "images" / name / f"{t:06d}.jpg", picture(100 + 20 * t))
            write_rgb(home / "mask" / name / f"{t:06d}.png", person_mask() // 255 * 7)
    intri.release()
    extri.release()
    upright = cv2.Rodrigues(np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]))[0].ravel()
    rows = {"poses": np.zeros((frames, 72)), "Rh": np.tile(upright, (frames, 1)), "Th": np.zeros((frames, 3))}
    rows["shapes"] = np.zeros((frames, 10))
    if as_json:
        (home / "smpl").mkdir()
        for t in range(frames):
            person = {"id": 0, **{key: [value[t].tolist()] for key, value in rows.items()}}
            (home / "smpl" / f"{t:06d}.json").write_text(json.dumps([person]))
    else:
        np.savez(home / "motion.npz", **rows)
    return home
