"""Reader of multi-view folders in EasyMocap's layout, which ZJU-MoCap and OcMotion are exchanged in.

    SEQ/intri.yml, extri.yml        names, K_NAME, dist_NAME; Rot_NAME, T_NAME (world -> camera, metres)
    SEQ/images/NAME/000000.jpg      one folder a camera
    SEQ/mask/NAME/000000.png        the person: 0..255, or a label picture whose 0 is nobody (also mask_cihp/, masks/)
    SEQ/motion.npz                  poses [T,72], Rh [T,3], Th [T,3], shapes [T,10]
    or SEQ/smpl/000000.json         a list with one object of the same names a frame

ZJU-MoCap's own `annots.npy` and `new_params/*.npy` are pickles, which run code when they are read: never read here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from ahoy_core.body.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from ahoy_core.captures.capture import BodyTruth, Capture, TruePicture, View
from ahoy_core.captures.files import camera, read_json, read_mask, read_picture, undistorted, unit
from ahoy_core.captures.smpl_truth import AVERAGE_PELVIS, pelvis, smpl_truth, turned_camera
from ahoy_core.captures.split import learned_and_unseen
from ahoy_core.conventions import Cameras
from ahoy_core.formats.npz import load_npz

_MASKS = ("mask", "masks", "mask_cihp")
_LABELS = 32  # a mask with no value above this holds labels of parts, not alpha
_PARTS = ("poses", "Rh", "Th", "shapes")


def is_multiview(folder: Path) -> bool:
    """Whether a folder has this layout."""
    return (folder / "intri.yml").is_file() and (folder / "images").is_dir()


def read_multiview(folder: Path, input_camera: str = "", truth_body: Path | None = None) -> Capture:
    """Read one sequence.

    Args:
        folder: of the sequence.
        input_camera: name of the camera whose pictures are the input; the first by default.
        truth_body: the user's `.npz` of the body that the parameters belong to.

    Raises:
        ValueError: a file is missing or damaged.
    """
    files = _pictures(folder)
    cameras, distortion = _cameras(folder, files)
    chosen = input_camera or next(iter(cameras))
    if chosen not in cameras:
        raise ValueError(f"expected an input camera among {sorted(cameras)}, got {chosen!r}")
    count = min(len(paths) for paths in files.values())
    learned, unseen = learned_and_unseen(count)
    truth = _truth(folder, count, truth_body)
    masks = next((folder / name for name in _MASKS if (folder / name).is_dir()), None)
    if masks is None:
        raise ValueError(f"expected masks in {folder}: one of the folders {', '.join(_MASKS)}, got none")

    def colour(name: str, number: int) -> NDArray[np.uint8]:
        return undistorted(read_picture(files[name][number])[..., :3], cameras[name].Ks[0], distortion[name])

    def picture(view: View) -> TruePicture:
        name = view.camera
        mask = read_mask(masks / name / f"{files[name][view.frame].stem}.png")
        if 0 < mask.max() <= _LABELS:
            mask = np.where(mask > 0, 255, 0).astype(np.uint8)
        alpha = unit(undistorted(mask, cameras[name].Ks[0], distortion[name]))
        return TruePicture(unit(colour(name, view.frame)), alpha, torch.ones_like(alpha, dtype=torch.bool))

    views = [View("view" if n in learned else "pose", name, n) for n in truth.frames for name in cameras]
    return Capture(
        name=folder.name,
        folder=folder,
        kind="multiview",
        views=(*views, *(View("input", chosen, number) for number in learned)),
        picture=picture,
        frames=lambda: [colour(chosen, number) for number in learned],
        fps=30.0,
        input_camera=chosen,
        cameras={name: turned_camera(one) for name, one in cameras.items()},
        bodies={"view": truth.within(learned), "pose": truth.within(unseen)},
        notes=() if truth_body else (AVERAGE_PELVIS,),
    )


def _pictures(folder: Path) -> dict[str, list[Path]]:
    endings = {".jpg", ".jpeg", ".png"}
    found = {
        place.name: sorted(path for path in place.iterdir() if path.suffix.lower() in endings)
        for place in sorted((folder / "images").iterdir())
        if place.is_dir()
    }
    if not found or not all(found.values()):
        raise ValueError(f"expected a folder of pictures a camera in {folder / 'images'}, got {sorted(found)}")
    return found


def _cameras(folder: Path, files: Mapping[str, Sequence[Path]]) -> tuple[dict[str, Cameras], dict[str, list[float]]]:
    intri = cv2.FileStorage(str(folder / "intri.yml"), cv2.FILE_STORAGE_READ)
    extri = cv2.FileStorage(str(folder / "extri.yml"), cv2.FILE_STORAGE_READ)
    cameras, distortion = {}, {}
    for name, paths in files.items():
        K, R, t = intri.getNode(f"K_{name}").mat(), extri.getNode(f"Rot_{name}").mat(), extri.getNode(f"T_{name}").mat()
        if K is None or R is None or t is None:
            raise ValueError(f"expected K_{name} in intri.yml, Rot_{name} and T_{name} in extri.yml of {folder}")
        height, width = read_picture(paths[0]).shape[:2]
        # OpenCV's pixel centres are at whole numbers, ours half a pixel further.
        cameras[name] = camera(K + np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]), R, t, width, height)
        bent = intri.getNode(f"dist_{name}").mat()
        distortion[name] = [] if bent is None else [float(value) for value in bent.ravel()]
    return cameras, distortion


def _truth(folder: Path, count: int, truth_body: Path | None) -> BodyTruth:
    if (folder / "motion.npz").is_file():
        arrays = load_npz(folder / "motion.npz", _PARTS)
        rows = list(range(min(count, len(arrays["poses"]))))
    else:
        found = {int(path.stem): path for path in sorted((folder / "smpl").glob("*.json"))}
        rows = [number for number in sorted(found) if number < count]
        people = [read_json(found[number]) for number in rows]
        arrays = {name: np.concatenate([np.atleast_2d(one[0][name]) for one in people]) for name in _PARTS if people}
    if not rows:
        raise ValueError(
            f"expected motion.npz or smpl/*.json in {folder}, got neither; ZJU-MoCap's own .npy files are pickles, "
            "which are never read: convert them with EasyMocap"
        )
    poses = torch.from_numpy(arrays["poses"][: len(rows)].astype(np.float64)).reshape(len(rows), -1, 3)
    if poses.shape[1] == 23:  # without the root, which is in Rh
        poses = torch.cat([torch.zeros(len(rows), 1, 3, dtype=torch.float64), poses], 1)
    turn = axis_angle_to_matrix(torch.from_numpy(arrays["Rh"][: len(rows)].astype(np.float64)).reshape(-1, 3))
    place = torch.from_numpy(arrays["Th"][: len(rows)].astype(np.float64)).reshape(-1, 3)
    joint = pelvis(torch.from_numpy(np.atleast_2d(arrays["shapes"])[0].astype(np.float64)), truth_body)
    # Rh and Th act on the posed body as a whole, about the origin of its rest space.
    poses[:, 0] = matrix_to_axis_angle(turn @ axis_angle_to_matrix(poses[:, 0]))
    return smpl_truth(poses, turn @ joint + place, rows)
