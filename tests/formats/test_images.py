"""PNG is lossless, conversions are exact, sheets show every picture whole."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from ahoy_core.formats.errors import ImageError
from ahoy_core.formats.images import contact_sheet, read_png, to_float, to_uint8, write_png


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("shape", [(7, 5), (7, 5, 3), (7, 5, 4), (1, 1, 3)])
def test_png_round_trip_is_lossless(tmp_path: Path, dtype: type, shape: tuple[int, ...]) -> None:
    image = np.random.default_rng(0).integers(0, np.iinfo(dtype).max, shape, dtype=dtype)
    write_png(tmp_path / "a.png", image)
    back = read_png(tmp_path / "a.png")
    assert back.dtype == dtype and np.array_equal(back, image)


def test_colour_under_full_transparency_survives(tmp_path: Path) -> None:
    image = np.zeros((2, 2, 4), np.uint8)
    image[..., 0] = 200
    write_png(tmp_path / "a.png", image)
    assert np.array_equal(read_png(tmp_path / "a.png"), image)


def test_png_stores_red_first(tmp_path: Path) -> None:
    import cv2

    write_png(tmp_path / "a.png", np.full((2, 2, 3), (255, 0, 0), np.uint8))
    assert cv2.imread(str(tmp_path / "a.png"))[0, 0].tolist() == [0, 0, 255]


@pytest.mark.parametrize("content", [b"", b"not an image", b"\x89PNG\r\n\x1a\n"])
def test_unreadable_images_are_named(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.png").write_bytes(content)
    with pytest.raises(ImageError, match=r"expected a PNG image, got 'a\.png'"):
        read_png(tmp_path / "a.png")


@pytest.mark.parametrize("image", [np.zeros((2, 2, 3)), np.zeros((2, 2, 2), np.uint8), np.zeros((0, 2, 3), np.uint8)])
def test_arrays_that_are_no_images_are_refused(tmp_path: Path, image: np.ndarray) -> None:
    with pytest.raises(ImageError, match="expected a non-empty uint8 or uint16"):
        write_png(tmp_path / "a.png", image)


def test_all_levels_survive_the_way_to_float_and_back() -> None:
    levels = np.arange(256, dtype=np.uint8).reshape(1, 16, 16, 1).repeat(3, axis=3)
    floats = to_float(levels)
    assert floats.shape == (1, 3, 16, 16) and floats.dtype == torch.float32
    assert floats.min() == 0 and floats.max() == 1
    assert np.array_equal(to_uint8(floats), levels)


def test_rounding_is_to_the_nearest_level_and_outside_is_clipped() -> None:
    values = torch.tensor([-1.0, 0.4 / 255, 0.6 / 255, 1.0, 7.0, float("nan")]).reshape(1, 1, 6)
    assert to_uint8(values).ravel().tolist() == [0, 0, 1, 255, 255, 0]


def test_channels_stay_with_their_pixels() -> None:
    image = np.random.default_rng(0).integers(0, 256, (4, 6, 3), dtype=np.uint8)
    assert torch.equal(to_float(image)[1], torch.from_numpy(image[..., 1]).float() / 255)


def test_wrong_kinds_are_refused_in_both_directions() -> None:
    with pytest.raises(ImageError, match="expected uint8"):
        to_float(np.zeros((2, 2, 3)))
    with pytest.raises(ImageError, match="floating point"):
        to_uint8(torch.zeros(3, 2, 2, dtype=torch.uint8))


def test_sheet_holds_every_picture_whole_and_in_order() -> None:
    rng = np.random.default_rng(0)
    images = [rng.integers(0, 200, (10 + i, 12, 3), dtype=np.uint8) for i in range(5)]
    sheet = contact_sheet(images, columns=2)
    places = []
    for image in images:
        height, width = image.shape[:2]
        windows = np.lib.stride_tricks.sliding_window_view(sheet, (height, width, 3))[:, :, 0]
        found = np.argwhere((windows == image).all(axis=(2, 3, 4)))
        assert len(found) == 1
        places.append(tuple(found[0]))
    assert places == sorted(places)
    assert [p[1] for p in places][::2] == [places[0][1]] * 3


def test_labels_leave_the_pictures_alone() -> None:
    images = [np.full((20, 80, 3), 90, np.uint8)] * 2
    plain, labelled = contact_sheet(images, columns=2), contact_sheet(images, ["front", "dos – ü"], columns=2)
    assert np.count_nonzero((labelled == 90).all(axis=2)) >= np.count_nonzero((plain == 90).all(axis=2))
    assert (labelled[:20] < 80).any()


def test_large_pictures_are_reduced_to_the_cell_in_proportion() -> None:
    sheet = contact_sheet([np.full((100, 200, 3), 7, np.uint8)], cell=50)
    rows, columns = np.nonzero((sheet == 7).all(axis=2))
    assert np.ptp(rows) + 1 == 25 and np.ptp(columns) + 1 == 50


@pytest.mark.parametrize(
    ("images", "labels", "columns"),
    [([], None, None), ([np.zeros((2, 2, 3))], None, None), ([np.zeros((2, 2, 3), np.uint8)], ["a", "b"], None),
     ([np.zeros((2, 2, 3), np.uint8)], None, 0)],
)  # fmt: skip
def test_impossible_sheets_are_refused(images: list, labels: list | None, columns: int | None) -> None:
    with pytest.raises(ImageError, match="expected"):
        contact_sheet(images, labels, columns)
