"""The self-check believes whoever paints hidden evidence right, and the symmetric fill where nobody can tell."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ahoy_core.prior.completion import Pictures
from ahoy_core.prior.selfcheck import BASELINE, MARGIN, hidden_region, self_check, winner_of

SIDE = 24


def surface() -> np.ndarray:
    """A flat square of points, one a pixel, left half red and right half blue."""
    y, x = np.mgrid[:SIDE, :SIDE] / SIDE
    return np.stack([x.ravel(), np.zeros(SIDE * SIDE), y.ravel()], 1)


def painting() -> torch.Tensor:
    image = torch.zeros(1, 3, SIDE, SIDE)
    image[:, 0, :, : SIDE // 2] = 1
    image[:, 2, :, SIDE // 2 :] = 1
    return image


def fill(kept: torch.Tensor) -> Pictures:
    """Grey where nothing is known."""
    coverage = kept.reshape(1, 1, SIDE, SIDE).float()
    return Pictures(painting() * coverage + 0.5 * (1 - coverage), torch.ones_like(coverage), coverage)


def test_who_paints_right_wins_and_its_error_is_reported() -> None:
    everything = np.ones(SIDE * SIDE, dtype=bool)
    rivals = {"oracle": lambda given: painting(), "worse": lambda given: 1 - painting()}
    check = self_check(surface(), everything, fill, rivals, np.random.default_rng(0))
    assert check.winner == "oracle" and check.confidence == pytest.approx(0, abs=1e-6) and check.regions == 3
    assert check.errors["worse"] > check.errors[BASELINE] == pytest.approx(0.5, abs=1e-4)


def test_a_tie_goes_to_the_symmetric_fill() -> None:
    everything = np.ones(SIDE * SIDE, dtype=bool)
    check = self_check(surface(), everything, fill, {"a copy": lambda given: given.frames}, np.random.default_rng(0))
    assert check.winner == BASELINE


def test_a_win_by_little_goes_to_the_simpler_and_is_taken_from_the_winner_before() -> None:
    little, much = 1 - 0.6 * MARGIN, 1 - 1.5 * MARGIN
    assert winner_of({BASELINE: 0.1, "clean-up": 0.1 * little}) == BASELINE
    assert winner_of({BASELINE: 0.1, "clean-up": 0.1 * much}) == "clean-up"
    assert winner_of({BASELINE: 0.1, "clean-up": 0.1 * much, "inversion": 0.1 * much * little}) == "clean-up"
    assert winner_of({BASELINE: 0.1, "clean-up": 0.1 * little, "inversion": 0.1 * much}) == "inversion"
    assert winner_of({BASELINE: 0.1, "clean-up": 0.1 * much, "inversion": 0.1 * much**2}) == "inversion"


def test_with_nothing_observed_there_is_no_competition() -> None:
    nothing = np.zeros(SIDE * SIDE, dtype=bool)
    check = self_check(surface(), nothing, fill, {"oracle": lambda given: painting()}, np.random.default_rng(0))
    assert check.winner == BASELINE and np.isnan(check.confidence) and "only 0 surface points" in check.note


def test_a_hidden_region_is_connected_observed_and_of_its_size() -> None:
    observed = np.arange(SIDE * SIDE) % SIDE < 12
    hidden = hidden_region(surface(), observed, np.random.default_rng(3), share=0.25)
    assert hidden.sum() == round(0.25 * observed.sum()) and not (hidden & ~observed).any()
    inside = surface()[hidden]
    assert float(np.linalg.norm(inside - inside.mean(0), axis=1).max()) < 0.6


def test_regions_follow_from_the_generator() -> None:
    observed = np.ones(SIDE * SIDE, dtype=bool)
    one, two = (hidden_region(surface(), observed, np.random.default_rng(1)) for _ in range(2))
    assert np.array_equal(one, two)
