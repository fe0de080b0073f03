"""Cameras of COLMAP (binary and text) and nerfstudio, against one set of cameras written in each way."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import pytest
import torch
from torch import Tensor

from ahoy_core.body.rotations import matrix_to_quaternion
from ahoy_core.conventions import look_at, project
from ahoy_core.formats.cameras import read_cameras
from ahoy_core.formats.errors import CameraFileError

EYES = torch.tensor([[3.0, -2.0, 1.0], [0.5, -4.0, 2.0], [-3.0, 0.0, 0.5]])
VIEWS = look_at(EYES, torch.tensor([0.2, 0.1, 0.9]))
FX, FY, CX, CY, W, H = 410.0, 400.0, 321.0, 239.0, 640, 480


def binary(folder: Path) -> Path:
    folder.mkdir(parents=True)
    head = struct.pack("<QiiQQ4d", 1, 7, 1, W, H, FX, FY, CX, CY)
    (folder / "cameras.bin").write_bytes(head)
    body = struct.pack("<Q", len(VIEWS))
    for number, view in enumerate(VIEWS):
        quat, shift = matrix_to_quaternion(view[:3, :3].double()).tolist(), view[:3, 3].tolist()
        body += struct.pack("<i7di", number + 1, *quat, *shift, 7) + f"im{number}.jpg".encode() + b"\0"
        body += struct.pack("<Q", 2) + bytes(48)
    (folder / "images.bin").write_bytes(body)
    return folder


def text(folder: Path, points: str = "1 2 -1") -> Path:
    folder.mkdir(parents=True)
    (folder / "cameras.txt").write_text(f"# comment\n7 PINHOLE {W} {H} {FX} {FY} {CX} {CY}\n")
    rows = ["# comment"]
    for number, view in enumerate(VIEWS):
        quat, shift = matrix_to_quaternion(view[:3, :3].double()).tolist(), view[:3, 3].tolist()
        rows += [" ".join(map(str, [number + 1, *quat, *shift, 7, f"im{number}.jpg"])), points]
    (folder / "images.txt").write_text("\n".join(rows) + "\n")
    return folder


def nerfstudio(folder: Path, **more: float) -> Path:
    folder.mkdir(parents=True)
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
    frames = [
        {"file_path": f"im{i}.jpg", "transform_matrix": (torch.linalg.inv(view) @ flip).tolist()}
        for i, view in enumerate(VIEWS)
    ]
    data = {"fl_x": FX, "fl_y": FY, "cx": CX, "cy": CY, "w": W, "h": H, "frames": frames, **more}
    (folder / "transforms.json").write_text(json.dumps(data))
    return folder / "transforms.json"


def seen(path: Path) -> Tensor:
    """Where a point is in every image: the same whatever the file's conventions."""
    file = read_cameras(path)
    assert file.names == ("im0.jpg", "im1.jpg", "im2.jpg") and set(file.sizes) == {(W, H)}
    return project(torch.tensor([[0.5, 0.3, 1.1]]), file.viewmats, file.Ks).pixels


@pytest.mark.parametrize("write", [binary, text, nerfstudio])
def test_every_layout_sees_a_point_at_the_same_pixel(tmp_path: Path, write):
    K = torch.tensor([[FX, 0, CX], [0, FY, CY], [0, 0, 1.0]]).expand(3, 3, 3)
    truth = project(torch.tensor([[0.5, 0.3, 1.1]]), VIEWS, K).pixels
    # float32 matrices of a scene of metres: a thousandth of a pixel.
    assert torch.allclose(seen(write(tmp_path / "s")), truth, atol=2e-3)


def test_colmap_is_found_below_its_usual_folders_and_with_empty_point_lines(tmp_path: Path):
    text(tmp_path / "s" / "sparse" / "0", points="")
    assert torch.allclose(seen(tmp_path / "s"), seen(binary(tmp_path / "b")), atol=2e-3)


def test_a_camera_is_chosen_by_name_or_number_and_scaled(tmp_path: Path):
    file = read_cameras(binary(tmp_path / "b"))
    half = file.chosen("im1.jpg", height=240)
    assert (half.width, half.height) == (320, 240)
    assert torch.allclose(half.Ks[0, :2], file.Ks[1, :2] / 2)
    assert torch.equal(file.chosen("2").viewmats, file.chosen(2).viewmats)
    for bad in ("im9.jpg", "7"):
        with pytest.raises(CameraFileError):
            file.chosen(bad)


def test_distortion_is_noted_and_fisheyes_are_refused(tmp_path: Path):
    assert any("distortion" in note for note in read_cameras(nerfstudio(tmp_path / "n", k1=0.1)).notes)
    folder = text(tmp_path / "t")
    (folder / "cameras.txt").write_text(f"7 OPENCV_FISHEYE {W} {H} {FX} {FY} {CX} {CY} 0 0 0 0\n")
    with pytest.raises(CameraFileError, match="undistort"):
        read_cameras(folder)


@pytest.mark.parametrize("name", ["images.bin", "cameras.bin"])
@pytest.mark.parametrize("share", [0.05, 0.5, 0.9])
def test_cut_off_binaries_are_refused(tmp_path: Path, name: str, share: float):
    folder = binary(tmp_path / "b")
    data = (folder / name).read_bytes()
    (folder / name).write_bytes(data[: int(share * len(data))])
    with pytest.raises(CameraFileError):
        read_cameras(folder)


def test_damaged_text_and_json_are_refused(tmp_path: Path):
    folder = text(tmp_path / "t")
    (folder / "images.txt").write_text((folder / "images.txt").read_text()[:60])
    with pytest.raises(CameraFileError):
        read_cameras(folder)
    path = nerfstudio(tmp_path / "n")
    path.write_text(path.read_text()[:100])
    with pytest.raises(CameraFileError):
        read_cameras(path)
    path.write_text('{"frames": []}')
    with pytest.raises(CameraFileError, match="at least one"):
        read_cameras(path)
    with pytest.raises(FileNotFoundError):
        read_cameras(tmp_path / "nowhere")
