from __future__ import annotations

import math

import pytest
import torch

from ahoy_core.metrics import INPUT_VIEW, Protocol, input_view_pair, iou, psnr, ssim
from ahoy_core.metrics.regions import mask_box


def _noise(seed: int, *shape: int) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def test_psnr_of_a_known_error():
    image = torch.zeros(3, 8, 8)
    assert psnr(image, image + 0.1) == pytest.approx(20.0, abs=1e-5)
    assert psnr(image, image + 1.0) == pytest.approx(0.0, abs=1e-5)


def test_psnr_of_equal_images_is_finite():
    assert psnr(_noise(0, 3, 8, 8), _noise(0, 3, 8, 8)) == pytest.approx(100.0)


def test_ssim_is_one_for_equal_images_and_falls_with_noise():
    image = _noise(1, 3, 32, 32)
    little, much = (ssim(image, (image + s * _noise(2, 3, 32, 32)).clamp(0, 1)) for s in (0.1, 0.6))
    assert ssim(image, image) == pytest.approx(1.0, abs=1e-5)
    assert much < little < 1


def test_iou_of_known_overlaps():
    first, second = torch.zeros(4, 4), torch.zeros(4, 4)
    first[:2], second[1:3] = 1, 1
    assert iou(first, second) == pytest.approx(1 / 3)
    assert iou(first, first) == 1
    assert iou(first, 1 - first) == 0
    assert iou(torch.zeros(4, 4), torch.zeros(4, 4)) == 1


def test_what_is_hidden_does_not_count_in_the_input_view():
    frame, mask = _noise(3, 3, 16, 16), torch.zeros(16, 16)
    mask[4:10, 3:8] = 1
    image = _noise(4, 3, 16, 16)
    image[:, 4:10, 3:8] = frame[:, 4:10, 3:8]
    first, second = input_view_pair(image, frame, mask)
    assert first.shape == (3, 6, 5)
    assert torch.equal(first, second)


def test_half_transparent_pixels_count_half():
    mask = torch.full((8, 8), 0.5)
    first, second = input_view_pair(torch.zeros(3, 8, 8), torch.ones(3, 8, 8), mask)
    assert torch.allclose(second - first, torch.full_like(first, 0.5))


def test_protocols_that_differ_have_different_ids():
    ids = {
        INPUT_VIEW.id(256, 256),
        INPUT_VIEW.id(128, 256),
        INPUT_VIEW.model_copy(update={"background": 0.0}).id(256, 256),
        INPUT_VIEW.model_copy(update={"region": "full"}).id(256, 256),
        Protocol(name="input-view", region=INPUT_VIEW.region, background=0.5, poses="true").id(256, 256),
    }
    assert len(ids) == 5
    assert INPUT_VIEW.id(256, 256).startswith("input-view/")


def test_mask_boxes():
    mask = torch.zeros(10, 12)
    mask[3:5, 6:9] = 1
    assert mask_box(mask) == (6, 3, 9, 5)
    assert mask_box(mask, margin=4) == (2, 0, 12, 9)
    with pytest.raises(ValueError, match="empty"):
        mask_box(torch.zeros(4, 4))


def test_shapes_that_differ_are_refused():
    for metric in (psnr, ssim):
        with pytest.raises(ValueError, match="of one shape"):
            metric(torch.zeros(3, 8, 8), torch.zeros(3, 8, 9))
    with pytest.raises(ValueError, match="of one shape"):
        iou(torch.zeros(8, 8), torch.zeros(8, 9))
    with pytest.raises(ValueError, match="empty region"):
        psnr(torch.zeros(3, 0, 8), torch.zeros(3, 0, 8))
    with pytest.raises(ValueError, match="sides above"):
        ssim(torch.zeros(3, 4, 40), torch.zeros(3, 4, 40))


def test_a_nan_is_not_hidden():
    assert math.isnan(psnr(torch.full((3, 8, 8), math.nan), torch.zeros(3, 8, 8)))
