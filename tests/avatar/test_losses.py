from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from ahoy_core.avatar.deform import Canonical, OffsetBounds, apply_offsets, offset_channels
from ahoy_core.avatar.losses import LossWeights, Neighbourhood, regularisers
from ahoy_core.maps.template import Template
from tests.avatar.scenes import template

NOTHING = LossWeights(offset=0, strain=0, scale=0, growth=0, scale_change=0, lbs=0)


def _still() -> tuple[Template, Canonical]:
    start = template(64)
    return start, apply_offsets(start, torch.zeros(len(start), offset_channels(start)), OffsetBounds())


def _value(canonical: Canonical, name: str) -> float:
    start = template(64)
    weights = NOTHING.model_copy(update={name: 1.0})
    return float(regularisers(canonical, start, Neighbourhood.of(start), weights))


@pytest.mark.parametrize("name", ["offset", "strain", "scale", "growth", "scale_change", "lbs"])
def test_the_template_itself_costs_nothing(name: str):
    assert _value(_still()[1], name) == pytest.approx(0, abs=1e-9)


def test_a_shift_of_everything_is_no_strain_and_a_lone_spike_is():
    _, still = _still()
    shifted = replace(still, means=still.means + torch.tensor([0.0, 0.03, 0.0]))
    spike = replace(still, means=still.means.index_add(0, torch.tensor([7]), torch.tensor([[0.0, 0.03, 0.0]])))
    assert _value(shifted, "strain") == pytest.approx(0, abs=1e-6)
    assert _value(spike, "strain") > 100 * _value(shifted, "strain")
    assert _value(spike, "offset") < 0.01 * _value(shifted, "offset")


def test_making_a_body_ten_percent_wider_strains_it_by_a_tenth_at_any_map_size():
    for size in (64, 128):
        start = template(size)
        still = apply_offsets(start, torch.zeros(len(start), offset_channels(start)), OffsetBounds())
        wider = replace(still, means=start.means * 1.1)
        weights = NOTHING.model_copy(update={"strain": 1.0})
        value = float(regularisers(wider, start, Neighbourhood.of(start), weights))
        assert 0.007 < value <= 0.0101


def test_growing_costs_and_shrinking_does_not():
    _, still = _still()
    assert _value(replace(still, scales=still.scales * 2), "growth") == pytest.approx(0.4805, abs=1e-3)
    assert _value(replace(still, scales=still.scales / 2), "growth") == 0
    assert _value(replace(still, scales=still.scales * 2), "scale_change") == pytest.approx(0, abs=1e-6)
