"""Reader of BEHAVE: four Kinects, people with objects, SMPL-H parameters.

    ROOT/calibs/DateNN/config/K/config.json            rotation, translation: camera K -> the world (that of camera 1)
    ROOT/calibs/intrinsics/K/calibration.json          color: fx, fy, cx, cy, width, height, opencv
    ROOT/sequences/SEQ/info.json                       where these are, relative to the sequence
    ROOT/sequences/SEQ/tNNNN.000/kK.color.jpg, .person_mask.jpg, .obj_rend_mask.jpg
    ROOT/sequences/SEQ/smpl_fit_all.npz                poses [T,156], betas [T,10], trans [T,3], frame_times
                                                       (or ROOT/behave-30fps-params-v1/SEQ/smpl_fit_all.npz)

The parameters beside each frame (`person/fit02/*.pkl`) are pickles, which run code when they are read: never read here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from ahoy_core.captures.capture import BodyTruth, Capture, TruePicture, View
from ahoy_core.captures.files import camera, read_json, read_mask, read_picture, undistorted, unit
from ahoy_core.captures.smpl_truth import AVERAGE_PELVIS, pelvis, smpl_truth, turned_camera
from ahoy_core.captures.split import learned_and_unseen
from ahoy_core.conventions import Cameras
from ahoy_core.formats.npz import load_npz

INPUT = "k1"
PARAMETERS = "smpl_fit_all.npz"
FPS = 1.0  # of the folders of a sequence


def is_behave(root: Path) -> bool:
    """Whether a folder is the root of the data set."""
    return (root / "sequences").is_dir() and (root / "calibs").is_dir()


def read_behave(root: Path, input_camera: str = INPUT, truth_body: Path | None = None) -> list[Capture]:
    """Read every sequence.

    Raises:
        ValueError: there is none, or a file is missing or damaged.
    """
    folders = sorted(path.parent for path in (root / "sequences").glob("*/info.json"))
    if not folders:
        raise ValueError(f"expected sequences/*/info.json in {root}, got none; give the root of BEHAVE")
    return [_sequence(root, folder, input_camera, truth_body) for folder in folders]


def _sequence(root: Path, folder: Path, input_camera: str, truth_body: Path | None) -> Capture:
    moments = sorted(path.name for path in folder.iterdir() if path.is_dir() and path.name.startswith("t"))
    cameras, distortion = _cameras(folder)
    if input_camera not in cameras:
        raise ValueError(f"expected an input camera among {sorted(cameras)}, got {input_camera!r}")
    learned, unseen = learned_and_unseen(len(moments))
    truth = _truth(root, folder, moments, truth_body)
    bodies = {
        "view": truth.within(learned),
        "pose": truth.within(unseen),
    }
    views = [
        View("view" if number in learned else "pose", name, number)
        for number in range(len(moments))
        for name in cameras
        if number in truth.frames and (folder / moments[number] / f"{name}.color.jpg").is_file()
    ]
    inputs = [View("input", input_camera, view.frame) for view in views if view.camera == input_camera]

    def colour(name: str, number: int) -> NDArray[np.uint8]:
        image = read_picture(folder / moments[number] / f"{name}.color.jpg")
        return undistorted(image, cameras[name].Ks[0], distortion[name])

    def picture(view: View) -> TruePicture:
        place = folder / moments[view.frame]
        K, bent = cameras[view.camera].Ks[0], distortion[view.camera]
        alpha = unit(undistorted(read_mask(place / f"{view.camera}.person_mask.jpg"), K, bent))
        hidden = torch.zeros_like(alpha, dtype=torch.bool)
        mask = place / f"{view.camera}.obj_rend_mask.jpg"
        if mask.is_file():
            hidden = (unit(undistorted(read_mask(mask), K, bent)) > 0.5) & (alpha <= 0.5)
        return TruePicture(unit(colour(view.camera, view.frame)), alpha, ~hidden)

    return Capture(
        name=folder.name,
        folder=folder,
        kind="behave",
        views=(*views, *(view for view in inputs if view.frame in learned)),
        picture=picture,
        frames=lambda: [colour(input_camera, number) for number in learned],
        fps=FPS,
        input_camera=input_camera,
        cameras={name: turned_camera(one) for name, one in cameras.items()},
        bodies=bodies,
        blur_faces=True,
        notes=() if truth_body else (AVERAGE_PELVIS,),
    )


def _cameras(folder: Path) -> tuple[dict[str, Cameras], Mapping[str, Sequence[float]]]:
    info = read_json(folder / "info.json")
    cameras, distortion = {}, {}
    for number in info.get("kinects", [0, 1, 2, 3]):
        colour = read_json(folder / info["intrinsic"] / str(number) / "calibration.json")["color"]
        pose = read_json(folder / info["config"] / str(number) / "config.json")
        R = np.asarray(pose["rotation"], dtype=np.float64).reshape(3, 3)
        K = [[colour["fx"], 0, colour["cx"]], [0, colour["fy"], colour["cy"]], [0, 0, 1]]
        # The file's pixel centres are at whole numbers, ours half a pixel further.
        K[0][2], K[1][2] = K[0][2] + 0.5, K[1][2] + 0.5
        name = f"k{number}"
        away = -R.T @ np.asarray(pose["translation"], dtype=np.float64).reshape(3)
        cameras[name] = camera(K, R.T, away, int(colour["width"]), int(colour["height"]))
        distortion[name] = list(colour.get("opencv", []))[4:]
    return cameras, distortion


def _truth(root: Path, folder: Path, moments: Sequence[str], truth_body: Path | None) -> BodyTruth:
    places = (folder / PARAMETERS, root / "behave-30fps-params-v1" / folder.name / PARAMETERS)
    path = next((place for place in places if place.is_file()), None)
    if path is None:
        raise ValueError(
            f"expected {PARAMETERS} in {folder} or {places[1].parent}, got none; download the 30 fps parameters: those "
            "beside the frames are pickles, which are never read"
        )
    arrays = load_npz(path, ["poses", "betas", "trans", "frame_times"])
    rows = {str(name): row for row, name in enumerate(arrays["frame_times"])}
    frames = [number for number, name in enumerate(moments) if name in rows]
    if not frames:
        raise ValueError(f"expected parameters of {moments[0]}, ... in {path}, got {sorted(rows)[:3]}, ...")
    chosen = [rows[moments[number]] for number in frames]
    poses = torch.from_numpy(arrays["poses"][chosen].astype(np.float64)).reshape(len(frames), -1, 3)
    root_joint = pelvis(torch.from_numpy(np.atleast_2d(arrays["betas"])[0].astype(np.float64)), truth_body)
    return smpl_truth(poses, torch.from_numpy(arrays["trans"][chosen].astype(np.float64)) + root_joint, frames)
