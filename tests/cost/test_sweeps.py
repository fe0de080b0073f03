"""Sweeps, the time model and the choice of knobs, on numbers whose answer is known."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from ahoy_core.cost import Measurement, Spread, sweep
from ahoy_core.cost.choose import Gains, alternatives, choose, worth_telling
from ahoy_core.cost.pace import measure_pace
from ahoy_core.cost.work import FRAMES, KNOBS, PIXELS, WORK, fit_times
from tasks.cost.declared import STAGE_SWEEPS
from tasks.cost.errors import SHARPNESS_DB, gain, psnr, rmse
from tasks.cost.measured import MeasuredSet, read_measured, write_measured
from tasks.cost.page import write_page
from tasks.cost.predict import Clip, Predictor, gains_of, work_knobs
from tasks.cost.rows import Rows
from tasks.cost.summary import omissions, over_captures
from tasks.presets import PRESETS
from tasks.settings import Settings

CLIP = {FRAMES: 48, PIXELS: 256 * 256}


def _knobs(**changes: Any) -> dict[str, Any]:
    return {**work_knobs(Settings(), CLIP), **{name.replace("__", "."): value for name, value in changes.items()}}


def _once(seconds: float) -> Spread:
    return Spread(seconds, seconds, seconds, 1)


def test_what_is_no_finite_number_did_not_converge_and_is_an_omission() -> None:
    rows = sweep("s", [{"k": 0}, {"k": 1}], lambda s: s["k"], lambda k: {"e": 1.0 if k else math.nan}, repeats=1)
    assert rows[0].failed == "did not converge: e is no finite number" and rows[0].cpu_s is None
    assert rows[1].errors == {"e": 1.0} and rows[1].peak_mb is not None and rows[1].peak_mb.median > 1


def test_without_a_warm_up_the_first_run_counts() -> None:
    calls: list[int] = []
    rows = sweep("s", [{"k": 1}], lambda s: calls.append(1), lambda _: {"e": 0.0}, repeats=2, warm=False)
    assert len(calls) == 2 and rows[0].cpu_s is not None and rows[0].cpu_s.repeats == 2


def test_every_term_of_every_stage_can_be_computed_from_the_settings_of_every_preset() -> None:
    for settings in PRESETS.values():
        knobs = work_knobs(settings, CLIP)
        assert set(knobs) == set(KNOBS)
        assert all(count >= 0 for terms in WORK.values() for count in terms(knobs).values())


def test_the_time_model_finds_rates_that_made_the_rows_and_predicts_other_knobs() -> None:
    def truth(steps: int, side: int) -> float:
        return 2.0 + 0.1 * steps + 0.05 * steps * (side / 128) ** 2

    rows = [
        ("coarse", _knobs(coarse__steps=steps, coarse__map_size=side), truth(steps, side))
        for steps, side in product((15, 60, 100), (64, 128))
    ]
    model = fit_times(rows)
    assert model.error["coarse"] < 1e-6
    assert model.seconds("coarse", _knobs(coarse__steps=80, coarse__map_size=256)) == pytest.approx(
        truth(80, 256), rel=0.02
    )
    assert model.seconds("avatar", _knobs()) is None


def test_no_rate_is_negative_so_that_more_work_never_costs_less() -> None:
    noisy = [("coarse", _knobs(coarse__steps=steps), seconds) for steps, seconds in ((30, 9.0), (60, 5.0), (100, 8.0))]
    model = fit_times(noisy)
    seconds = [model.seconds("coarse", _knobs(coarse__steps=steps)) or 0.0 for steps in (10, 50, 200)]
    assert seconds == sorted(seconds) and seconds[0] > 0


GAINS = Gains(
    {"a.steps": {10: -2.0, 20: 0.0, 80: 1.0}, "b.size": {1: -0.5, 2: 0.0, 4: 0.4}, "c.mode": {"x": 0.0, "y": -0.1}},
    {"a.steps": 20, "b.size": 2, "c.mode": "x"},
)


def _seconds(changes: dict[str, Any]) -> float:
    now = {**GAINS.base, **changes}
    return now["a.steps"] * 1.0 + 10.0 * now["b.size"] + (5.0 if now["c.mode"] == "x" else 0.0)


@pytest.mark.parametrize("budget", [20.0, 31.0, 45.0, 60.0, 100.0, 124.0, 125.0, 1000.0])
def test_the_choice_is_the_best_of_all_combinations_that_fit(budget: float) -> None:
    found = choose(GAINS, _seconds, budget)
    every = [dict(zip(GAINS.by_knob, values, strict=True)) for values in product(*GAINS.by_knob.values())]
    fitting = [
        (sum(GAINS.by_knob[k][v] for k, v in one.items()), -_seconds(one)) for one in every if _seconds(one) <= budget
    ]
    if not fitting:
        assert not found.fits and found.seconds == min(map(_seconds, every))
        return
    assert found.fits and (found.gain, -found.seconds) == pytest.approx(max(fitting))


@pytest.mark.parametrize("seed", range(8))
def test_values_that_another_beats_in_both_are_left_out_without_changing_the_choice(seed: int) -> None:
    """Gains without order, as measured ones are, and seconds that are products of knobs."""
    rng = np.random.default_rng(seed)
    sizes = {
        "a.steps": (15, 30, 60, 80, 120),
        "b.size": (64, 128, 256),
        "c.frames": (16, 48),
        "d.mode": ("x", "y", "z"),
    }
    base = {"a.steps": 60, "b.size": 128, "c.frames": 48, "d.mode": "x"}
    by_knob = {
        k: {v: 0.0 if v == base[k] else float(rng.normal(0, 0.2)) for v in values} for k, values in sizes.items()
    }
    by_knob["d.mode"]["z"] = -1.0
    gains = Gains(by_knob, base)
    extra = {"x": rng.random(), "y": rng.random(), "z": 2.0}
    rates, calls = rng.random(3), 0

    def seconds(changes: Mapping[str, Any]) -> float:
        nonlocal calls
        calls += 1
        a, b, c, d = ({**base, **changes}[knob] for knob in base)
        return float(rates[0] * a * b / 256 + rates[1] * c + rates[2] * b * c / 256 + extra[d])

    every = [dict(zip(sizes, values, strict=True)) for values in product(*sizes.values())]
    priced = [(seconds(one), sum(by_knob[k][v] for k, v in one.items())) for one in every]
    for budget in np.quantile([took for took, _ in priced], (0.1, 0.3, 0.6, 1.0)):
        calls = 0
        found = choose(gains, seconds, float(budget))
        best = max(((gain, -took) for took, gain in priced if took <= budget))
        assert found.fits and (found.gain, -found.seconds) == pytest.approx(best)
        assert calls < len(every) + 12, "mode z, dearer and worse than x, was tried with all others"


def test_a_larger_budget_never_buys_less_and_values_in_between_fill_it() -> None:
    found = [choose(GAINS, _seconds, budget, ("a.steps",)) for budget in range(25, 140, 5)]
    gains = [one.gain for one in found]
    assert gains == sorted(gains)
    filled = [one.seconds / budget for one, budget in zip(found, range(25, 140, 5), strict=True) if one.fits]
    assert sorted(filled)[len(filled) // 2] > 0.85
    assert any(one.changes.get("a.steps", 20) not in (10, 20, 80) for one in found)


def test_what_falls_with_more_steps_is_chance_and_leaves_no_time_unused() -> None:
    """As measured: 15 steps of a training scored better than 30 and 60, 120 best."""
    gains = Gains({"a.steps": {15: -0.04, 30: -0.20, 60: -0.09, 120: 0.0}, "b.size": {1: -1.0, 2: 0.0}},
                  {"a.steps": 120, "b.size": 2})  # fmt: skip
    assert gains.rising(["a.steps"]).by_knob["a.steps"] == pytest.approx({15: -0.12, 30: -0.12, 60: -0.09, 120: 0.0})
    assert gains.rising(["a.steps"]).by_knob["b.size"] == gains.by_knob["b.size"]

    def seconds(changes: Mapping[str, Any]) -> float:
        now = {**gains.base, **changes}
        return float(now["a.steps"] + 10 * now["b.size"])

    found = choose(gains, seconds, 110.0, ("a.steps",))
    assert found.seconds > 0.85 * 110 and 60 < found.changes["a.steps"] < 120
    assert choose(gains, seconds, 110.0).changes["a.steps"] == 15, "a knob that is no training keeps what was measured"
    # The base may be among those that were levelled; it gains nothing over itself.
    levelled = Gains({"a.steps": {60: 0.0, 100: -0.04}}, {"a.steps": 60}).rising(["a.steps"])
    assert levelled.by_knob["a.steps"] == pytest.approx({60: 0.0, 100: 0.0})


def test_gains_between_measured_values_lie_on_a_line_over_the_logarithm_and_none_are_made_up_outside() -> None:
    assert GAINS.at("a.steps", 40) == pytest.approx(0.5)
    assert GAINS.at("a.steps", 5) is None and GAINS.at("a.steps", 160) is None and GAINS.at("c.mode", "z") is None


def test_what_more_would_buy_is_what_gains_most_a_second_first() -> None:
    found = choose(GAINS, _seconds, 31.0)
    assert found.beyond and [one.seconds / one.gain for one in found.beyond] == sorted(
        one.seconds / one.gain for one in found.beyond
    )
    buys, saves = worth_telling(alternatives(GAINS, {**GAINS.base}, _seconds), 0.05, 5)
    assert [one.value for one in buys] == [4, 80]  # 0.4 dB for 20 s, 1 dB for 60 s
    assert saves[0].value == "y" and all(one.seconds < 0 for one in saves)
    with pytest.raises(ValueError, match="above 0"):
        choose(GAINS, _seconds, 0.0)


def _whole(knob: str, value: Any, db: float, seconds: float, capture: str = "a", **knobs: Any) -> Measurement:
    return Measurement(
        f"end-to-end.{knob}", {knob: value}, {"rmse": rmse(db)}, _once(seconds), _once(seconds), capture=capture,
        knobs=_knobs(**knobs), parts={"coarse": seconds / 3, "avatar": 2 * seconds / 3},
    )  # fmt: skip


def test_the_measured_set_survives_its_file_and_gives_gains_over_its_base(tmp_path: Path) -> None:
    rows = [_whole("preset", "draft", 20.0, 60), _whole("avatar.steps", 240, 20.5, 110, avatar__steps=240)]
    facts = {"machine": {"cpu": "x"}, "unit_cpu_s": 0.03, "base": {"preset": "draft", "overrides": []}}
    write_measured(tmp_path / "set.json", [*rows, replace(rows[0], failed="no")], facts)
    found = read_measured((tmp_path / "set.json").read_text())
    assert list(found.rows) == rows and found.unit_cpu_s == 0.03
    gains = gains_of(found)
    assert gains.base == {"avatar.steps": PRESETS["draft"].avatar.steps}
    assert gains.by_knob["avatar.steps"][240] == pytest.approx(0.5)
    assert not gains_of(found, fixed=["avatar.steps"]).by_knob
    with pytest.raises(ValueError, match="version"):
        read_measured('{"schema_version": 99}')


def test_sharpness_is_bought_where_it_was_measured_on_both_sides_and_blur_is_not() -> None:
    base, sharp, blurred = (
        {"rmse": rmse(db), "perceptual": distance} for db, distance in ((21.0, 0.17), (20.9, 0.16), (21.1, 0.2))
    )
    assert gain(sharp, base) == pytest.approx(SHARPNESS_DB * 0.01 - 0.1) and gain(sharp, base) > 0 > gain(blurred, base)
    assert gain({"rmse": rmse(20.9)}, base) == pytest.approx(-0.1) == pytest.approx(gain(sharp, {"rmse": rmse(21.0)}))


def test_both_fronts_of_whole_runs_are_marked(tmp_path: Path) -> None:
    rows = []
    for name, db, seconds, distance in (
        ("draft", 21, 60, 0.17),
        ("standard", 20.9, 200, 0.16),
        ("high", 20.8, 300, 0.165),
    ):
        levels = {f"{kind}rmse": rmse(db) for kind in ("", "view_", "pose_", "head_")}
        errors = {**levels, "ssim_loss": 0.3, "perceptual": distance}
        rows.append(replace(_whole("preset", name, db, seconds), errors=errors))
    write_page(rows, {"preset": "draft", "base": "preset draft", "machine": "this"}, tmp_path / "cost.md")
    cells = [
        line.split(" | ") for line in (tmp_path / "cost.md").read_text().splitlines() if line.startswith("| preset")
    ]
    marks = {row[1]: row[-1].removesuffix("|").strip() for row in cells}
    assert marks == {"draft": "PSNR, perceptual", "standard": "perceptual", "high": ""}


def test_a_gain_is_the_least_over_all_captures_of_the_base() -> None:
    rows = (
        _whole("preset", "draft", 20.0, 60),
        _whole("preset", "draft", 22.0, 60, capture="b"),
        _whole("avatar.steps", 240, 20.5, 110),
    )
    found = MeasuredSet(rows, 0.03, {"cpu": "x"}, "draft", ())
    assert found.gains() == {}, "half a decibel on the worse of two captures says nothing of the other"
    for on_b, least in ((22.1, 0.1), (21.7, -0.3), (23.0, 0.5)):
        both = replace(found, rows=(*rows, _whole("avatar.steps", 240, on_b, 110, capture="b")))
        assert both.gains()["avatar.steps"][240] == pytest.approx(least), "what one capture gains, the other may lose"
    failed = replace(_whole("avatar.steps", 240, 22.5, 110, capture="b"), failed="MemoryError")
    assert replace(found, rows=(*rows, failed)).gains() == {}


def test_a_single_change_of_another_preset_is_worth_what_its_own_row_is_over_the_base() -> None:
    """On one capture the preset gains .1 and its change .4, on the other .5 and .2: minima must not be added up."""
    rows = []
    for capture, preset, changed in (("a", 0.1, 0.4), ("b", 0.5, 0.2)):
        rows.append(_whole("preset", "draft", 20.0, 60, capture))
        rows.append(_whole("preset", "standard", 20.0 + preset, 200, capture))
        row = _whole("avatar.steps", 30, 20.0 + changed, 100, capture)
        rows.append(replace(row, setting={"preset": "standard", "avatar.steps": 30}))
    found = MeasuredSet(tuple(rows), 0.03, {"cpu": "x"}, "draft", ())
    assert found.rounds() == {"draft": 0.0, "standard": pytest.approx(0.1)} and not found.gains()
    assert found.rounds()["standard"] + found.gains("standard")["avatar.steps"][30] == pytest.approx(0.2)


def test_a_prediction_knows_the_video_and_scales_with_the_machine(tmp_path: Path) -> None:
    rows = [
        Measurement("perceive.stride", {"stride": 1}, {"e": 1.0}, _once(n), _once(n), knobs=_knobs(clip__frames=n))
        for n in (10, 20, 40)
    ]
    facts = {"machine": {"cpu": "x"}, "unit_cpu_s": 0.03, "base": {"preset": "draft", "overrides": []}}
    write_measured(tmp_path / "set.json", rows, facts)
    found = read_measured((tmp_path / "set.json").read_text())
    base = PRESETS["draft"]
    long, short = (Clip(np.arange(n) / 15, 256, 256) for n in (480, 12))
    assert Predictor(found, base, long, 1.0).seconds({}) == pytest.approx(48, rel=0.01)  # draft keeps 48
    assert Predictor(found, base, short, 1.0).seconds({}) == pytest.approx(12, rel=0.01)
    assert Predictor(found, base, long, 2.0).seconds({"ingest.max_frames": 16}) == pytest.approx(32, rel=0.01)


def test_the_self_check_is_predicted_where_there_is_a_prior_to_check() -> None:
    run = replace(_whole("preset", "draft", 20.0, 60), parts={"texture": 5.0, "complete": 15.0})
    found = MeasuredSet((run,), 0.03, {"cpu": "x"}, "draft", ())
    clip, without = Clip(np.arange(48) / 15, 256, 256), Settings().with_overrides(["prior=none"])
    assert Predictor(found, Settings(), clip, 1.0).seconds({}) == pytest.approx(20, rel=0.01)
    assert Predictor(found, without, clip, 1.0).seconds({}) == pytest.approx(5, rel=0.01)


def test_rows_are_found_again_shared_between_sweeps_and_survive_a_torn_line(tmp_path: Path) -> None:
    row = Measurement("coarse.steps", {"steps": 60}, {"rmse": 20.0}, _once(5), _once(5), capture="a", made_of="h1")
    Rows(tmp_path).add(row)
    with (tmp_path / "rows.jsonl").open("a") as file:
        file.write('{"sweep": "coarse.st')
    rows = Rows(tmp_path)
    assert rows.rows == [row]
    assert rows.reuse("h1", "coarse.width", {"width": 16}, 1) and not rows.reuse("h2", "coarse.steps", {"steps": 30}, 1)
    assert not rows.reuse("h1", "coarse.width", {"width": 16}, 2), "run once, asked for twice"
    assert [(one.sweep, dict(one.setting)) for one in Rows(tmp_path).rows] == [
        ("coarse.steps", {"steps": 60}), ("coarse.width", {"width": 16}),
    ]  # fmt: skip


def test_a_failed_row_is_tried_again_and_replaced(tmp_path: Path) -> None:
    bad = Measurement("coarse.steps", {"steps": 1}, failed="ValueError: no", capture="a", made_of="h")
    rows = Rows(tmp_path)
    rows.add(bad)
    assert not rows.reuse("h", "coarse.steps", {"steps": 1}, 1)
    good = replace(bad, failed="", errors={"rmse": 1.0}, cpu_s=_once(1), wall_s=_once(1))
    rows.add(good)
    assert Rows(tmp_path).rows == [good]


def test_captures_are_averaged_and_what_is_missing_is_an_omission() -> None:
    rows = [_whole("preset", "draft", 20.0, 60), _whole("preset", "draft", 22.0, 80, capture="b")]
    failed = replace(rows[0], setting={"preset": "high"}, failed="MemoryError: none\nlong story")
    (mean,) = over_captures([*rows, failed])
    assert mean.cpu_s is not None and mean.cpu_s.median == 70 and mean.capture == "a, b"
    assert psnr(mean.errors["rmse"]) == pytest.approx(21, abs=0.1)
    said = omissions([*rows, failed], "draft")
    assert "end-to-end.preset = high, capture a: MemoryError: none" in said
    assert "end-to-end.preset = standard: not measured yet" in said and "texture.rule: not measured yet" in said
    assert "end-to-end.standard.avatar.steps: not measured yet" in said
    assert "end-to-end.draft.avatar.steps: not measured yet" in omissions([], "high"), "a base without knobs of its own"
    assert any(line.startswith("hallucinate: no sweep of its own") for line in said)


def test_every_declared_knob_is_one_of_its_stage_and_takes_its_values() -> None:
    for name, declared in STAGE_SWEEPS.items():
        config = getattr(Settings(), name)
        for knob, values in declared.knobs.items():
            for value in values:
                changed = type(config).model_validate({**config.model_dump(), knob: value})
                assert getattr(changed, knob) == value


def test_the_unit_of_pace_takes_time_and_leaves_the_threads_as_they_were() -> None:
    before = torch.get_num_threads()
    pace = measure_pace(0.2)
    assert 0 < pace.cpu_s < 10 and pace.wall_s > 0 and torch.get_num_threads() == before
