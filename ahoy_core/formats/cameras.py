"""Cameras of reconstructed scenes: COLMAP's `cameras`/`images` (binary or text) and nerfstudio's `transforms.json`."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import torch
from torch import Tensor

from ahoy_core.body.rotations import quaternion_to_matrix
from ahoy_core.conventions import Cameras
from ahoy_core.formats.errors import CameraFileError

# COLMAP's models by number: name, parameters. Those after the fourth (k1, k2, ...) are lens distortion.
_MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
}
_MAX_IMAGES = 10_000_000


@dataclass(frozen=True)
class CameraFile:
    """Cameras of N images in the scene's units and axes.

    Attributes:
        names: N image names.
        viewmats: [N,4,4] world -> camera, OpenCV axes.
        Ks: [N,3,3] pixels.
        sizes: N (width, height).
        notes: What was ignored, one sentence each.
    """

    names: tuple[str, ...]
    viewmats: Tensor
    Ks: Tensor
    sizes: tuple[tuple[int, int], ...]
    notes: tuple[str, ...] = ()

    def chosen(self, name: str | int, height: int | None = None) -> Cameras:
        """One camera, by image name or number, optionally at another height (the width follows).

        Raises:
            CameraFileError: No such image.
        """
        number = name if isinstance(name, int) else self._number(name)
        if not 0 <= number < len(self.names):
            raise CameraFileError(f"expected a camera among 0 to {len(self.names) - 1}, got {number}")
        width, full = self.sizes[number]
        factor = 1.0 if height is None else height / full
        K = self.Ks[number].clone()
        K[:2] *= factor
        return Cameras(self.viewmats[number][None], K[None], max(1, round(width * factor)), round(full * factor))

    def _number(self, name: str) -> int:
        if name.isdigit():
            return int(name)
        if name not in self.names:
            raise CameraFileError(f"expected an image among {list(self.names)[:5]} ..., got {name!r}")
        return self.names.index(name)


def read_cameras(path: str | Path) -> CameraFile:
    """Read COLMAP's model folder (or one of its files) or nerfstudio's `transforms.json`.

    Raises:
        FileNotFoundError: Nothing there.
        CameraFileError: Malformed or cut off, or a fisheye lens, which a pinhole can't stand for.
    """
    source = Path(path)
    if source.suffix == ".json":
        return _nerfstudio(source)
    folder = source if source.is_dir() else source.parent
    for inside in (folder, folder / "sparse" / "0", folder / "sparse"):
        for kind in (".bin", ".txt"):
            pair = inside / f"cameras{kind}", inside / f"images{kind}"
            if all(file.is_file() for file in pair):
                try:
                    return _colmap_binary(*pair) if kind == ".bin" else _colmap_text(*pair)
                except (struct.error, ValueError, IndexError, UnicodeDecodeError) as error:
                    if isinstance(error, CameraFileError):
                        raise
                    raise CameraFileError(f"expected COLMAP's {pair[1].name!r} whole, got {error}") from error
    raise FileNotFoundError(f"expected cameras and images (.bin or .txt) or a transforms.json at {str(path)!r}")


def _intrinsics(model: int, numbers: list[float]) -> tuple[Tensor, bool]:
    """K [3,3] and whether there is lens distortion.

    Raises:
        CameraFileError: For a fisheye lens or an unknown model.
    """
    if model not in _MODELS or "FISHEYE" in _MODELS[model][0]:
        found = _MODELS.get(model, (f"model {model}", 0))[0]
        raise CameraFileError(f"expected a pinhole camera, got {found}; undistort the images (image_undistorter)")
    simple = model in (0, 2, 3)
    fx, fy, cx, cy = (numbers[0], numbers[0], *numbers[1:3]) if simple else numbers[:4]
    bent = any(abs(k) > 1e-9 for k in numbers[3 if simple else 4 :])
    return torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), bent


def _assembled(lenses: Mapping[int, tuple[int, int, int, list[float]]], images: list[Any]) -> CameraFile:
    names, viewmats, Ks, sizes, bent = [], [], [], [], False
    for name, lens, quat, shift in images:
        model, width, height, numbers = lenses[lens]
        K, distorted = _intrinsics(model, numbers)
        viewmat = torch.eye(4, dtype=torch.float64)
        viewmat[:3, :3] = quaternion_to_matrix(torch.tensor(quat, dtype=torch.float64))
        viewmat[:3, 3] = torch.tensor(shift, dtype=torch.float64)
        bent |= distorted
        names.append(name)
        viewmats.append(viewmat.float())
        Ks.append(K)
        sizes.append((width, height))
    if not names:
        raise CameraFileError("expected at least one image, got none; is the reconstruction empty?")
    notes = ("lens distortion was ignored: undistort the images for pictures that match",) if bent else ()
    return CameraFile(tuple(names), torch.stack(viewmats), torch.stack(Ks), tuple(sizes), notes)


def _colmap_binary(cameras: Path, images: Path) -> CameraFile:
    lenses = {}
    with cameras.open("rb") as handle:
        (count,) = _unpack(handle, "<Q")
        for _ in range(count):
            number, model, width, height = _unpack(handle, "<iiQQ")
            if model not in _MODELS:
                raise CameraFileError(f"expected a known COLMAP model, got number {model}; convert to PINHOLE")
            lenses[number] = (model, width, height, list(_unpack(handle, f"<{_MODELS[model][1]}d")))
    found = []
    with images.open("rb") as handle:
        (count,) = _unpack(handle, "<Q")
        if count > _MAX_IMAGES:
            raise CameraFileError(f"expected at most {_MAX_IMAGES} images, got {count}; is it another kind of file?")
        for _ in range(count):
            _, *pose, lens = _unpack(handle, "<i7di")
            name = _text(handle)
            (points,) = _unpack(handle, "<Q")
            handle.seek(24 * points, 1)
            found.append((name, lens, pose[:4], pose[4:]))
        end = handle.tell()
        handle.seek(0, 2)
        if end > handle.tell():
            raise CameraFileError(f"expected {images.name!r} whole, got {handle.tell()} bytes: is it cut off?")
    return _assembled(lenses, found)


def _unpack(handle: BinaryIO, layout: str) -> tuple[Any, ...]:
    return struct.unpack(layout, handle.read(struct.calcsize(layout)))


def _text(handle: BinaryIO) -> str:
    letters = bytearray()
    while (letter := handle.read(1)) != b"\0":
        if not letter:
            raise CameraFileError("expected the end of an image's name, got the end of the file: is it cut off?")
        letters += letter
    return letters.decode("utf-8")


def _colmap_text(cameras: Path, images: Path) -> CameraFile:
    names = {name: number for number, (name, _) in _MODELS.items()}
    lenses = {}
    for line in _lines(cameras):
        number, model, width, height, *numbers = line.split()
        lenses[int(number)] = (names.get(model, -1), int(width), int(height), [float(n) for n in numbers])
    found = []
    # Every image takes two lines; the second, its points, may be empty.
    lines = [line for line in images.read_text(encoding="utf-8").splitlines() if not line.startswith("#")]
    for line in lines[::2]:
        if line.strip():
            _, *pose, lens, name = line.split(maxsplit=9)
            placed = [float(number) for number in pose]
            if len(placed) != 7:
                raise CameraFileError(f"expected an image's 10 fields, got {line[:60]!r}: is the file cut off?")
            found.append((name, int(lens), placed[:4], placed[4:]))
    return _assembled(lenses, found)


def _lines(path: Path) -> list[str]:
    text = path.read_text(encoding="utf-8").splitlines()
    return [line for line in text if line.strip() and not line.startswith("#")]


def _nerfstudio(path: Path) -> CameraFile:
    """OpenGL cameras (x right, y up, looking along -z), stored camera -> world."""
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        frames = data["frames"]
        flip = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
        viewmats, Ks, sizes, bent = [], [], [], False
        for frame in frames:
            own = {**data, **frame}
            to_world = torch.tensor(own["transform_matrix"], dtype=torch.float64)
            if to_world.shape[0] == 3:
                to_world = torch.cat([to_world, torch.tensor([[0.0, 0.0, 0.0, 1.0]]).double()])
            viewmats.append(torch.linalg.inv(to_world @ flip).float())
            width, height = int(own["w"]), int(own["h"])
            focal = own.get("fl_x") or 0.5 * width / math.tan(0.5 * own["camera_angle_x"])
            cx, cy = own.get("cx", width / 2), own.get("cy", height / 2)
            Ks.append(torch.tensor([[focal, 0, cx], [0, own.get("fl_y") or focal, cy], [0, 0, 1.0]]))
            sizes.append((width, height))
            bent |= any(abs(own.get(k, 0.0)) > 1e-9 for k in ("k1", "k2", "k3", "k4", "p1", "p2"))
        names = tuple(str(frame.get("file_path", i)) for i, frame in enumerate(frames))
    except FileNotFoundError:
        raise
    except (KeyError, TypeError, ValueError, IndexError, RuntimeError) as error:
        raise CameraFileError(f"expected nerfstudio's transforms in {path.name!r}, got {error!r}") from error
    if not names:
        raise CameraFileError(f"expected at least one frame in {path.name!r}, got none")
    notes = ("lens distortion was ignored: undistort the images for pictures that match",) if bent else ()
    return CameraFile(names, torch.stack(viewmats), torch.stack(Ks), tuple(sizes), notes)
