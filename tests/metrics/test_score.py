"""Scores of one picture: regions, references, unknown pixels, and SSIM against two other implementations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity
from torchmetrics.functional.image import structural_similarity_index_measure

from ahoy_core.metrics.images import ssim_map
from ahoy_core.metrics.score import Made, Truth, flat, score_picture, shifted

SIZE = 64
BOX = (slice(10, 54), slice(20, 48))


def _noise(seed: int, *shape: int) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def _truth() -> Truth:
    alpha = torch.zeros(SIZE, SIZE)
    alpha[BOX] = 1
    observed = torch.zeros(SIZE, SIZE, dtype=torch.bool)
    observed[:30] = True
    smooth = torch.nn.functional.avg_pool2d(_noise(0, 1, 3, SIZE + 8, SIZE + 8), 9, 1)[0]
    return Truth(smooth, alpha, torch.ones(SIZE, SIZE, dtype=torch.bool), observed, (24, 10, 44, 26))


def _perfect(truth: Truth) -> Made:
    return Made(truth.rgb * truth.alpha + 0.5 * (1 - truth.alpha), truth.alpha)


def _by_region(made: Made, truth: Truth, pixels: str = "whole person") -> dict:
    return {score.region: score for score in score_picture(made, truth, pixels)}  # type: ignore[arg-type]


def test_the_truth_itself_scores_best_in_every_region() -> None:
    scores = _by_region(_perfect(_truth()), _truth())
    assert set(scores) == {"box", "mask", "full", "observed", "unobserved", "head"}
    for score in scores.values():
        assert score.psnr == pytest.approx(100) and score.ssim == pytest.approx(1, abs=1e-5)
    assert scores["box"].iou == scores["mask"].iou == 1 and scores["head"].iou is None


def test_an_error_on_hidden_surface_shows_in_its_regions_alone() -> None:
    truth, made = _truth(), _perfect(_truth())
    made.rgb[:, 40:50, 25:45] += 0.2
    scores = _by_region(made, truth)
    assert scores["observed"].psnr == pytest.approx(100) and scores["head"].psnr == pytest.approx(100)
    inside = 24 * 28  # pixels of the mask below row 30
    assert scores["unobserved"].psnr == pytest.approx(-10 * np.log10(0.04 * 200 / inside), abs=1e-3)
    assert scores["full"].psnr > scores["box"].psnr  # the same error over more pixels


def test_pixels_whose_truth_is_not_known_do_not_count() -> None:
    known = torch.ones(SIZE, SIZE, dtype=torch.bool)
    known[40:] = False
    truth = replace(_truth(), known=known)
    made = _perfect(truth)
    made.rgb[:, 41:] = 0
    made.alpha[41:] = 0
    scores = _by_region(made, truth)
    assert scores["box"].psnr == pytest.approx(100) and scores["box"].iou == 1
    made.rgb[:, 38:40] = 0
    assert _by_region(made, truth)["box"].psnr < 40


def test_what_is_hidden_does_not_count_where_the_visible_part_is_compared() -> None:
    truth, made = _truth(), _perfect(_truth())
    made.rgb[:, :10] = 1.0
    made.rgb[:, 54:] = 0.0
    assert _by_region(made, truth, "visible part")["full"].psnr == pytest.approx(100)
    assert _by_region(made, truth)["full"].psnr < 20
    assert _by_region(made, truth, "visible part")["box"].iou is None


def test_references_are_what_they_say() -> None:
    truth = _truth()
    moved, plain = shifted(truth), flat(truth)
    assert torch.equal(moved.rgb[:, 20, 30], truth.rgb[:, 20, 28]) and moved.alpha[20, 20] == 0
    assert moved.alpha[:, :2].sum() == 0  # nothing comes in from the other side
    assert torch.allclose(plain.rgb[:, 20, 30], plain.rgb[:, 50, 40])
    assert torch.allclose(plain.rgb[:, 20, 30], truth.rgb[:, truth.alpha > 0.5].mean(1), atol=1e-6)
    scores = _by_region(moved, truth)["box"], _by_region(plain, truth)["box"]
    assert scores[0].iou < 1 and scores[1].iou == 1 and scores[0].psnr < 100 and scores[1].psnr < 100


def test_a_picture_of_another_size_is_refused() -> None:
    with pytest.raises(ValueError, match="render at that"):
        score_picture(Made(torch.zeros(3, 32, 32), None), _truth(), "whole person")


def test_ssim_agrees_with_skimage_and_torchmetrics_away_from_the_border() -> None:
    # They treat borders and the number of samples differently; inside, all three are the formula of Wang et al. 2004.
    first = torch.nn.functional.avg_pool2d(_noise(1, 1, 3, 72, 72), 9, 1)[0]
    second = (first + 0.1 * _noise(2, 3, 64, 64)).clamp(0, 1)
    ours = ssim_map(first, second)[:, 5:-5, 5:-5]
    _, theirs = structural_similarity(
        first.numpy(), second.numpy(), channel_axis=0, data_range=1.0, gaussian_weights=True, sigma=1.5,
        use_sample_covariance=False, full=True,
    )  # fmt: skip
    assert np.abs(ours.numpy() - theirs[:, 5:-5, 5:-5]).max() < 2e-4  # float32 variances as differences of squares
    _, whole = structural_similarity_index_measure(
        first[None], second[None], data_range=1.0, kernel_size=11, sigma=1.5, return_full_image=True
    )
    inside = whole[0][:, 5:-5, 5:-5] if whole.shape[-1] == 64 else whole[0]
    assert float((ours - inside).abs().max()) < 1e-3  # both in float32
