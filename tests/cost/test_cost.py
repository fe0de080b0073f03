"""Meters and sweeps."""

from __future__ import annotations

import math
import subprocess
import sys
import time
from pathlib import Path

import pytest

from ahoy_core.cost import Measurement, Meter, Spread, machine, pareto, read_jsonl, sweep, write_jsonl


def _row(cpu: float, error: float) -> Measurement:
    return Measurement("s", {"k": cpu}, {"e": error}, Spread(cpu, cpu, cpu, 1), Spread(cpu, cpu, cpu, 1))


def test_pareto_keeps_exactly_the_rows_that_nothing_beats() -> None:
    rows = [_row(1, 9), _row(2, 9.5), _row(3, 4), _row(4, 4), _row(5, 1), _row(0.5, math.nan)]
    assert [r.setting["k"] for r in pareto(rows, "e")] == [1, 3, 5]


def test_settings_take_turns_so_that_drift_hits_all_alike() -> None:
    calls: list[int] = []
    sweep("s", [{"k": 1}, {"k": 2}], lambda s: calls.append(s["k"]), lambda _: {"e": 0.0}, repeats=2)
    assert calls == [1, 2, 1, 2, 1, 2]


def test_a_failing_setting_is_an_omission_and_the_others_are_measured() -> None:
    rows = sweep("s", [{"k": 0}, {"k": 2}], lambda s: 1 / s["k"], lambda r: {"e": r}, repeats=1)
    assert "ZeroDivisionError" in rows[0].failed and rows[0].cpu_s is None
    assert rows[1].errors == {"e": 0.5} and rows[1].cpu_s is not None


def test_rows_survive_the_file(tmp_path: Path) -> None:
    rows = [_row(1, 2), Measurement("s", {"k": "x"}, failed="no")]
    write_jsonl(tmp_path / "rows.jsonl", rows)
    assert read_jsonl(tmp_path / "rows.jsonl") == rows


def test_a_meter_tells_waiting_from_working() -> None:
    with Meter() as waiting:
        time.sleep(0.2)
    with Meter() as working:
        until = time.process_time() + 0.2
        while time.process_time() < until:
            pass
    assert waiting.read().cpu_s < 0.15 <= working.read().cpu_s


PASSING_ALLOCATION = """
import time
import numpy as np
from ahoy_core.cost import Meter
with Meter() as before:
    pass
with Meter() as meter:
    block = np.ones(32 * 2**20)
    time.sleep(0.25)
    del block
print(meter.read().peak_rss_mb - before.read().peak_rss_mb)
"""


def test_a_meter_sees_a_passing_allocation() -> None:
    # A process of its own: what other tests left behind (hundreds of megabytes) may go while this one looks.
    done = subprocess.run([sys.executable, "-c", PASSING_ALLOCATION], check=True, capture_output=True, text=True)
    assert float(done.stdout) > 200


def test_the_machine_is_named() -> None:
    assert {"cpu", "cores", "packages"} <= set(machine())


def test_zero_repeats_are_refused() -> None:
    with pytest.raises(ValueError, match="repeats >= 1"):
        sweep("s", [{}], lambda s: 0, lambda r: {}, repeats=0)
