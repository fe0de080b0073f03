"""Units, frames and cameras."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from ahoy_core.body.canonical import canonical_pose, canonical_transl
from ahoy_core.body.keypoints import LANDMARK_NAMES, keypoints
from ahoy_core.body.packaged import load_packaged_body
from ahoy_core.conventions import (
    OBSERVED_VIEWMAT,
    Cameras,
    canonical_cameras,
    look_at,
    person_crop,
    person_image,
    perspective_K,
    project,
    turntable_cameras,
)


@pytest.fixture(scope="module")
def canonical() -> tuple[Tensor, dict[str, Tensor]]:
    body = load_packaged_body()
    output = body(canonical_pose(body)[None], body.default_betas[None], canonical_transl(body)[None])
    return output.vertices[0], dict(zip(LANDMARK_NAMES, keypoints(body, output)[0], strict=True))


def test_observed_camera_sees_the_left_hand_on_the_right_and_the_head_on_top() -> None:
    points = torch.tensor([[0.5, 3.0, 0.0], [0.0, 3.0, 0.8], [0.0, 3.0, 0.0]])
    pixels, depths = project(points, OBSERVED_VIEWMAT, perspective_K(math.radians(60), 256, 256))
    assert pixels[0, 0] > 128
    assert pixels[1, 1] < 128
    torch.testing.assert_close(pixels[2], torch.tensor([128.0, 128.0]))
    torch.testing.assert_close(depths, torch.full((3,), 3.0))
    assert float(torch.det(OBSERVED_VIEWMAT)) == pytest.approx(1.0)


def test_look_at_from_the_origin_along_y_is_the_observed_camera() -> None:
    torch.testing.assert_close(look_at(torch.zeros(3), torch.tensor([0.0, 2.0, 0.0])), OBSERVED_VIEWMAT)


def test_look_at_puts_the_target_on_the_axis_and_up_upwards() -> None:
    eye, target = torch.tensor([1.0, -2.0, 0.5]), torch.tensor([-0.3, 0.4, 1.0])
    viewmat = look_at(eye, target)
    pixels, depths = project(torch.stack([target, target + torch.tensor([0, 0, 0.1])]), viewmat, torch.eye(3))
    torch.testing.assert_close(pixels[0], torch.zeros(2), atol=1e-6, rtol=0)
    assert float(depths[0]) == pytest.approx(float((target - eye).norm()))
    assert pixels[1, 1] < 0


def test_look_at_straight_down_is_refused() -> None:
    with pytest.raises(ValueError, match="another `up`"):
        look_at(torch.tensor([0.0, 0.0, 5.0]), torch.zeros(3))


@pytest.mark.parametrize(("width", "height"), [(640, 360), (360, 640)])
def test_field_of_view_spans_the_longer_side(width: int, height: int) -> None:
    K = perspective_K(math.radians(90), width, height)
    edge = torch.tensor([[1.0, 0, 1]]) if width > height else torch.tensor([[0.0, 1, 1]])
    pixels, _ = project(edge, torch.eye(4), K)
    assert float(pixels.max()) == pytest.approx(640)
    with pytest.raises(ValueError, match="radians"):
        perspective_K(60.0, width, height)


def test_front_camera_sees_the_face_and_left_camera_the_left_side(canonical: tuple[Tensor, dict[str, Tensor]]) -> None:
    vertices, landmarks = canonical
    front, left, back, right = (canonical_cameras(vertices, 128, 96)[i] for i in range(4))

    def depth(camera: Cameras, name: str) -> float:
        return float(camera.project(landmarks[name][None]).depths)

    def across(camera: Cameras, name: str) -> float:
        return float(camera.project(landmarks[name][None]).pixels[0, 0, 0])

    for name in LANDMARK_NAMES[:11]:
        if name != "nose":
            assert depth(front, "nose") < depth(front, name)
            assert depth(back, "nose") > depth(back, name)
    assert depth(left, "left_shoulder") < depth(left, "right_shoulder")
    assert depth(right, "right_shoulder") < depth(right, "left_shoulder")
    assert across(front, "left_wrist") > 48 > across(front, "right_wrist")
    assert across(back, "left_wrist") < 48 < across(back, "right_wrist")
    assert across(left, "left_foot_index") < across(left, "left_heel"), "seen from the left, a person looks left"


@pytest.mark.parametrize(("height", "width"), [(200, 80), (80, 200), (128, 128)])
def test_canonical_cameras_frame_the_box_and_ten_percent(height: int, width: int) -> None:
    rng = torch.Generator().manual_seed(0)
    vertices = torch.rand(500, 3, generator=rng, dtype=torch.float64) * torch.tensor([1.2, 0.4, 1.8]) + 3.0
    extent = vertices.amax(0) - vertices.amin(0)
    cameras = canonical_cameras(vertices, height, width)
    pixels, depths = cameras.project(vertices)
    assert (depths > 0.1).all()
    low, high = pixels.amin(1), pixels.amax(1)
    size = high - low
    assert float(torch.maximum(size[:, 0].max() / width, size[:, 1].max() / height)) == pytest.approx(1 / 1.1)
    torch.testing.assert_close(0.5 * (low + high), torch.tensor([[width / 2, height / 2]] * 4, dtype=torch.float64))
    scale = cameras.Ks[0, 0, 0]
    torch.testing.assert_close(size[0], scale * extent[[0, 2]])
    torch.testing.assert_close(size[1], scale * extent[[1, 2]])


def test_orthographic_pixels_do_not_depend_on_depth() -> None:
    K = torch.tensor([[50.0, 0, 10], [0, 50.0, 20], [0, 0, 1]])
    points = torch.tensor([[0.1, 0.2, 1.0], [0.1, 0.2, 9.0]])
    pixels, _ = project(points, torch.eye(4), K, "ortho")
    torch.testing.assert_close(pixels, torch.tensor([[15.0, 30.0], [15.0, 30.0]]))
    with pytest.raises(ValueError, match="'ortho'"):
        project(points, torch.eye(4), K, "fisheye")  # type: ignore[arg-type]


def test_turntable_starts_in_front_and_goes_to_the_left() -> None:
    center = torch.tensor([0.3, 0.1, 1.0])
    cameras = turntable_cameras(center, 2.5, 8, math.radians(10), 64, 48, 70.0)
    offsets = cameras.centers - center
    torch.testing.assert_close(offsets.norm(dim=-1), torch.full((8,), 2.5))
    assert offsets[0, 1] < 0
    assert offsets[2, 0] > 2
    assert (offsets[:, 2] > 0.4).all()
    pixels, depths = cameras.project(center[None])
    torch.testing.assert_close(pixels, torch.tensor([24.0, 32.0]).expand(8, 1, 2), atol=1e-4, rtol=0)
    torch.testing.assert_close(depths, torch.full((8, 1), 2.5))


def test_cameras_project_one_set_for_all_or_one_each() -> None:
    cameras = turntable_cameras(torch.zeros(3), 3.0, 4, 0.0, 32, 32, 40.0)
    points = torch.rand(5, 3, generator=torch.Generator().manual_seed(0))
    together = cameras.project(points)
    each = cameras.project(points.expand(4, 5, 3))
    torch.testing.assert_close(together.pixels, each.pixels)
    assert cameras[1].project(points).pixels.shape == (1, 5, 2)
    assert len(cameras[1:3]) == 2
    torch.testing.assert_close(cameras[[2]].project(points).pixels[0], together.pixels[2])
    assert cameras.to(dtype=torch.float64).Ks.dtype == torch.float64


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"viewmats": torch.eye(4)}, r"viewmats \[C,4,4\]"),
        ({"Ks": torch.eye(3).expand(2, 3, 3)}, r"Ks \[1,3,3\]"),
        ({"width": 0}, "positive image size"),
        ({"camera_model": "fisheye"}, "'ortho'"),
        ({"viewmats": 2 * torch.eye(4)[None]}, "rigid"),
        ({"Ks": -torch.eye(3)[None]}, "focal"),
    ],
)
def test_impossible_cameras_are_refused(change: dict[str, object], message: str) -> None:
    given = {"viewmats": torch.eye(4)[None], "Ks": torch.eye(3)[None], "width": 4, "height": 4}
    with pytest.raises(ValueError, match=message):
        Cameras(**{**given, **change})  # type: ignore[arg-type]


def person_mask(height: int, width: int, box: tuple[int, int, int, int]) -> Tensor:
    x0, y0, x1, y1 = box
    mask = torch.zeros(1, height, width)
    mask[:, y0:y1, x0:x1] = 1
    return mask


def test_person_fills_ninety_percent_of_the_height_in_the_middle() -> None:
    mask = person_mask(200, 300, (120, 40, 180, 160))
    out = person_image(torch.ones(3, 200, 300), mask, torch.eye(3), 64, 64)
    rows = torch.nonzero(out.mask[0].amax(1) > 0.5)[:, 0]
    columns = torch.nonzero(out.mask[0].amax(0) > 0.5)[:, 0]
    assert abs(len(rows) - 0.9 * 64) <= 1
    assert abs(len(columns) - 0.9 * 64 / 2) <= 1
    assert abs(float(rows.float().mean()) - 31.5) <= 0.5
    assert out.image.shape == (3, 64, 64)
    torch.testing.assert_close(out.image[:, 0, 0], torch.full((3,), 0.5))
    torch.testing.assert_close(out.image[:, 32, 32], torch.ones(3))


def test_a_wide_person_is_not_cut() -> None:
    crop = person_crop(person_mask(100, 300, (10, 40, 290, 60)), 64, 64)
    ends = torch.tensor([[10.0, 50.0], [290.0, 50.0]]) @ crop[:2, :2].T + crop[:2, 2]
    torch.testing.assert_close(ends[:, 0], torch.tensor([3.2, 60.8]))


def test_crop_intrinsics_project_points_to_where_the_crop_moved_them() -> None:
    K = perspective_K(math.radians(50), 300, 200)
    points = torch.tensor([[0.1, 3.0, 0.4], [-0.3, 2.5, -0.2], [0.0, 4.0, 0.0]])
    out = person_image(torch.rand(3, 200, 300), person_mask(200, 300, (120, 40, 180, 160)), K, 96, 64)
    in_frame, _ = project(points, OBSERVED_VIEWMAT, K)
    in_crop, _ = project(points, OBSERVED_VIEWMAT, out.K)
    torch.testing.assert_close(out.from_frame(in_frame), in_crop, atol=1e-3, rtol=0)
    torch.testing.assert_close(out.to_frame(in_crop), in_frame, atol=1e-3, rtol=0)


@pytest.mark.parametrize("size", [(32, 40), (96, 120), (500, 400)])
def test_resampling_moves_content_as_the_crop_says(size: tuple[int, int]) -> None:
    """A linear ramp stays the same function of the frame's pixels, when shrinking and when growing."""
    v, u = torch.meshgrid(torch.arange(200) + 0.5, torch.arange(300) + 0.5, indexing="ij")
    image = torch.stack([u / 300, v / 200, torch.ones_like(u)])
    inner = person_mask(200, 300, (120, 40, 180, 160))
    crop = person_crop(inner, *size)
    out = person_image(image, torch.ones(1, 200, 300), torch.eye(3), *size, crop=crop)
    y, x = torch.meshgrid(torch.arange(size[0]) + 0.5, torch.arange(size[1]) + 0.5, indexing="ij")
    where = out.to_frame(torch.stack([x, y], dim=-1))
    inside = (out.mask[0] > 0.9999) & (where[..., 0] > 10) & (where[..., 0] < 290)
    inside &= (where[..., 1] > 10) & (where[..., 1] < 190)
    assert inside.float().mean() > 0.3
    torch.testing.assert_close(out.image[0][inside], where[..., 0][inside] / 300, atol=3e-3, rtol=0)
    torch.testing.assert_close(out.image[1][inside], where[..., 1][inside] / 200, atol=3e-3, rtol=0)
    torch.testing.assert_close(out.image[2][inside], torch.ones(int(inside.sum())), atol=1e-3, rtol=0)


def test_shrinking_averages_fine_stripes_away() -> None:
    stripes = (torch.arange(300) % 2).float().expand(3, 400, 300)
    out = person_image(stripes, torch.ones(400, 300), torch.eye(3), 40, 30)
    inside = out.mask[0] > 0.9999
    assert (out.image[:, inside] - 0.5).abs().max() < 0.02


def test_an_empty_mask_and_a_mask_of_another_size_are_refused() -> None:
    with pytest.raises(ValueError, match="without a subject"):
        person_crop(torch.zeros(10, 10), 32, 32)
    with pytest.raises(ValueError, match="of one size"):
        person_image(torch.zeros(3, 10, 10), torch.ones(9, 10), torch.eye(3), 32, 32)
