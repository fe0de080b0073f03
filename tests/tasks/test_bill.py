"""The bill beside its prediction, from stages whose cost is known exactly."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ahoy_core.cost import Measurement, Spread
from ahoy_core.cost.work import FRAMES, PIXELS
from ahoy_core.formats.npz import save_npz
from storage_schema.manifest import Manifest
from tasks.bill import run_bill
from tasks.cost.errors import rmse
from tasks.cost.measured import MeasuredSet
from tasks.cost.predict import work_knobs
from tasks.presets import PRESETS
from tasks.report import page_environment
from tasks.settings import Settings
from tasks.stage import StageContext

DRAFT = PRESETS["draft"]


def _row(knob: str, value: object, db: float, steps: int) -> Measurement:
    """A whole run whose avatar takes half a CPU second a step."""
    took = Spread(steps / 2, steps / 2, steps / 2, 1)
    knobs = work_knobs(DRAFT, {FRAMES: 4, PIXELS: 64}) | {"avatar.steps": steps}
    return Measurement(
        f"end-to-end.{knob}", {knob: value}, {"rmse": rmse(db)}, took, took, capture="a", knobs=knobs,
        parts={"avatar": steps / 2},
    )  # fmt: skip


@pytest.fixture
def measured() -> MeasuredSet:
    base = DRAFT.avatar.steps
    rows = (_row("preset", "draft", 20, base), _row("avatar.steps", 30, 19.5, 30), _row("avatar.steps", 240, 21, 240))
    return MeasuredSet(rows, 0.05, {"cpu": "x"}, "draft", ())


def _context(tmp_path: Path, settings: Settings, cpu_s: float) -> StageContext:
    save_npz(tmp_path / "frames.npz", {"frames": np.zeros((4, 8, 8, 3), np.uint8)})
    manifests = {}
    for name in ("ingest", "perceive", "texture", "coarse", "avatar"):
        bill = {"wall_s": 2 * cpu_s, "cpu_s": cpu_s, "peak_rss_mb": 100.0}
        config = getattr(settings, name).model_dump(mode="json")
        manifests[name] = Manifest(1, "k", name, 1, "a", "now", config, {}, {}, {"bill": bill}, (), "h")
    return StageContext({"ingest": tmp_path}, manifests, tmp_path, lambda done, total, note="": None)


def test_the_prediction_is_what_the_same_work_took_before(measured: MeasuredSet, tmp_path: Path) -> None:
    bill = run_bill(_context(tmp_path, DRAFT, 120.0), measured)
    rows = {row.stage: row for row in bill.rows}
    assert rows["avatar"].predicted_s == pytest.approx(DRAFT.avatar.steps / 2, rel=0.01)
    assert rows["coarse"].predicted_s is None and rows["coarse"].cpu_s == 120.0
    assert bill.factor == pytest.approx(120.0 / (DRAFT.avatar.steps / 2), rel=0.01)


def test_what_would_have_been_bought_and_saved_is_scaled_by_this_machine(measured: MeasuredSet, tmp_path: Path) -> None:
    bill = run_bill(_context(tmp_path, DRAFT, float(DRAFT.avatar.steps)), measured)  # twice as slow as predicted
    (more,), (less,) = bill.buys, bill.saves
    assert (more.knob, more.value, less.value) == ("avatar.steps", 240, 30)
    assert more.gain == pytest.approx(1.0) and more.seconds == pytest.approx(240 - DRAFT.avatar.steps, rel=0.01)
    assert less.gain == pytest.approx(-0.5) and less.seconds == pytest.approx(30 - DRAFT.avatar.steps, rel=0.01)


def test_a_run_at_another_value_is_told_from_there_and_one_outside_is_not_told(
    measured: MeasuredSet, tmp_path: Path
) -> None:
    def at(steps: int) -> Settings:
        return DRAFT.with_overrides([f"avatar.steps={steps}"])

    (more,) = run_bill(_context(tmp_path, at(60), 30.0), measured).buys[:1]
    assert more.before == 60 and 0 < more.gain < 2
    far = run_bill(_context(tmp_path, at(999), 30.0), measured)
    assert not far.buys and not far.saves


def test_a_run_is_told_what_knobs_gain_beside_the_preset_that_it_is_most_like(
    measured: MeasuredSet, tmp_path: Path
) -> None:
    standard, steps = PRESETS["standard"], PRESETS["standard"].avatar.steps
    more = (
        replace(_row("preset", "standard", 21.0, steps), knobs=work_knobs(standard, {FRAMES: 4, PIXELS: 64})),
        replace(_row("avatar.steps", 480, 25.0, 480), sweep="end-to-end.standard.avatar.steps",
                setting={"preset": "standard", "avatar.steps": 480}),
    )  # fmt: skip
    both = replace(measured, rows=(*measured.rows, *more))
    for settings, preset, values in ((standard, "standard", {480}), (DRAFT, "draft", {30, 240})):
        bill = run_bill(_context(tmp_path, settings, 30.0), both)
        assert f"round preset {preset}" in bill.measured_on
        assert {one.value for one in (*bill.buys, *bill.saves)} == values


def test_without_whole_runs_the_bill_is_there_and_names_no_knob(measured: MeasuredSet, tmp_path: Path) -> None:
    bill = run_bill(_context(tmp_path, DRAFT, 10.0), replace(measured, rows=()))
    assert len(bill.rows) == 5 and bill.factor == 1.0 and not (bill.buys or bill.saves)


def test_the_page_shows_bill_prediction_and_knobs(measured: MeasuredSet, tmp_path: Path) -> None:
    bill = run_bill(_context(tmp_path, DRAFT, 120.0), measured)
    page = page_environment().get_template("report.html.j2").render(
        bill=bill, shares=[20.0] * 5, total_wall=1.0, total_cpu=1.0, total_predicted=60.0, sections=[], videos=[],
        roles=[], absent=[],
    )  # fmt: skip
    assert "What other knobs would have bought" in page and "avatar.steps" in page and "+1.00" in page
    assert "predicted CPU seconds" in page and "2.00 times as many" in page
