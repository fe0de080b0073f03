"""Means, paired differences and their bootstrap; the alignment of estimated poses."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ahoy_core.body.rotations import axis_angle_to_matrix
from ahoy_core.metrics.alignment import fit_similarity
from ahoy_core.metrics.compare import capture_means, check_one_protocol, interval, paired_difference


def _row(capture: str, config: str, frame: int, psnr: float | None, identity: str = "p/1") -> dict:
    same = {"protocol": "p", "region": "box", "camera": "left", "protocol_id": identity}
    return {**same, "capture": capture, "config": config, "frame": frame, "psnr": psnr}


def _rows(captures: int, gain: float = 1.0) -> list[dict]:
    """Captures differ by 5 dB, frames by 1; the second configuration is `gain` better on each."""
    rng = np.random.default_rng(0)
    rows = []
    for number in range(captures):
        for frame in range(6):
            base = 20 + 5 * number + rng.normal()
            rows += [_row(f"c{number}", "full", frame, base + gain), _row(f"c{number}", "C2", frame, base)]
    return rows


def test_captures_count_alike_however_many_frames_they_have() -> None:
    rows = [_row("a", "full", 0, 20.0), *(_row("b", "full", t, 30.0) for t in range(9)), _row("b", "full", 9, None)]
    assert capture_means(rows, "psnr") == {"a": 20.0, "b": 30.0}


def test_pairing_removes_what_captures_and_frames_have_in_common() -> None:
    found = paired_difference(_rows(3), "C2", "full", "psnr")
    assert found.mean == pytest.approx(-1) and found.pairs == 18
    assert found.by_capture == pytest.approx({"c0": -1, "c1": -1, "c2": -1})


def test_frames_that_one_of_them_lacks_are_left_out() -> None:
    rows = [row for row in _rows(2) if not (row["config"] == "C2" and row["frame"] == 0)]
    assert paired_difference(rows, "C2", "full", "psnr").pairs == 10
    assert paired_difference(rows, "D", "full", "psnr").mean is None


def test_fewer_than_five_captures_have_no_interval() -> None:
    assert paired_difference(_rows(4), "C2", "full", "psnr").interval is None
    assert paired_difference(_rows(5), "C2", "full", "psnr").interval is not None


def test_the_bootstrap_draws_captures_not_frames() -> None:
    # Ten captures, each 100 equal frames: frame by frame the interval would be ten times too narrow.
    values = np.random.default_rng(1).normal(size=10)
    rows = []
    for number, value in enumerate(values):
        for t in range(100):
            rows += [_row(f"c{number:02d}", "x", t, 20 + value), _row(f"c{number:02d}", "full", t, 20.0)]
    found = paired_difference(rows, "x", "full", "psnr")
    assert found.interval is not None
    width = found.interval[1] - found.interval[0]
    assert width == pytest.approx(2 * 1.96 * values.std() / np.sqrt(10), rel=0.1)  # the normal approximation's width


def test_the_interval_covers_the_mean_about_as_often_as_it_says() -> None:
    rng, hits = np.random.default_rng(2), 0
    for trial in range(200):
        low, high = interval(rng.normal(size=12), seed=trial)  # type: ignore[misc]
        hits += low <= 0 <= high
    assert 0.86 < hits / 200 < 0.99  # a percentile bootstrap of 12 values covers somewhat less than 95%


def test_rows_of_two_protocols_are_never_put_together() -> None:
    rows = [*_rows(1), _row("a", "full", 0, 20.0, "p/2")]
    for refuse in (
        lambda: check_one_protocol(rows),
        lambda: capture_means(rows, "psnr"),
        lambda: paired_difference(rows, "C2", "full", "psnr"),
    ):
        with pytest.raises(ValueError, match=r"one protocol id[\s\S]*p/1\n  p/2"):
            refuse()


def test_a_similarity_is_found_again() -> None:
    g = torch.Generator().manual_seed(0)
    points = torch.randn(20, 3, generator=g, dtype=torch.float64)
    turn = axis_angle_to_matrix(torch.tensor([0.4, -1.2, 2.0], dtype=torch.float64))
    shift = torch.tensor([5.0, -3.0, 100.0], dtype=torch.float64)
    found = fit_similarity(points, 1.7 * points @ turn.T + shift)
    assert float(found.scale) == pytest.approx(1.7, abs=1e-9)
    assert torch.allclose(found.rotation, turn, atol=1e-9) and torch.allclose(found.shift, shift, atol=1e-7)
    covariance = torch.diag(torch.tensor([1.0, 4.0, 9.0], dtype=torch.float64))
    assert torch.allclose(found.covariances(covariance), 1.7**2 * turn @ covariance @ turn.T, atol=1e-9)


def test_a_mirror_image_is_not_turned_inside_out() -> None:
    points = torch.randn(20, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    found = fit_similarity(points, points * torch.tensor([-1.0, 1, 1], dtype=torch.float64))
    assert float(torch.linalg.det(found.rotation)) == pytest.approx(1)


def test_joints_that_determine_no_alignment_are_refused() -> None:
    line = torch.arange(5.0)[:, None] * torch.tensor([[1.0, 2.0, 3.0]])
    with pytest.raises(ValueError, match="one line"):
        fit_similarity(line, line)
    with pytest.raises(ValueError, match="finite"):
        fit_similarity(torch.full((4, 3), float("nan")), torch.zeros(4, 3))
    with pytest.raises(ValueError, match=">= 3 points"):
        fit_similarity(torch.zeros(2, 3), torch.zeros(2, 3))
