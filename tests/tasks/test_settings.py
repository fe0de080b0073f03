"""Overrides by name, and the presets."""

from __future__ import annotations

import pytest

from tasks.presets import PRESETS
from tasks.settings import Settings


def test_an_override_reaches_its_knob_and_no_other() -> None:
    changed = Settings().with_overrides(["coarse.steps=7", "coarse.weights.scale=0.5", "ingest.end_s=2.5"])
    assert (changed.coarse.steps, changed.coarse.weights.scale, changed.ingest.end_s) == (7, 0.5, 2.5)
    back = changed.with_overrides(
        [f"coarse.steps={Settings().coarse.steps}", f"coarse.weights.scale={Settings().coarse.weights.scale}"]
    )
    assert back.with_overrides(["ingest.end_s=null"]) == Settings()


@pytest.mark.parametrize("text", ["coarse.steps", "steps=3", "coarse.stepz=3", "coarse.weights=3", "=", "coarse.=1"])
def test_what_names_no_knob_is_refused_with_the_list(text: str) -> None:
    with pytest.raises(ValueError, match=r"coarse\.weights\.scale"):
        Settings().with_overrides([text])


def test_a_value_out_of_range_says_where_and_what() -> None:
    with pytest.raises(ValueError, match=r"coarse\.steps.*got 0"):
        Settings().with_overrides(["coarse.steps=0"])


def test_draft_spends_less_and_high_more_than_standard() -> None:
    for stage, knob in (("ingest", "max_size"), ("texture", "atlas_size"), ("coarse", "map_size")):
        values = [getattr(getattr(PRESETS[name], stage), knob) for name in ("draft", "standard", "high")]
        assert values[0] < values[1] < values[2], (stage, knob, values)
    steps = [PRESETS[name].coarse.steps for name in ("draft", "standard", "high")]
    assert steps[0] == steps[1] < steps[2], "standard's row with draft's steps is the better one (docs/cost.md)"
