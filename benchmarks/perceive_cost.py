"""What accuracy costs in perception: `python -m benchmarks.perceive_cost CAPTURES_DIR --json OUT --picture PNG`.

Each knob is swept alone, the others at their defaults, over the first `--frames` of the captures below CAPTURES_DIR.
Errors are means over the captures; seconds are CPU seconds a frame of everything that perception does, on one thread.
The picture draws PA-MPJPE over time, both on logarithmic axes, and rings the Pareto set.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import torch

from ahoy_core.body.packaged import load_packaged_body
from ahoy_core.cost.sweep import Measurement, pareto, sweep, write_jsonl
from ahoy_core.perceive.perceive import PerceiveConfig, perceive
from benchmarks.captures import Capture, capture_folders, read_capture
from benchmarks.perceive import FPS, compare, load_networks

matplotlib.use("agg")
from matplotlib import pyplot

SWEEPS: Mapping[str, Sequence[Any]] = {
    "passes": (1, 2, 4),
    "iterations": (1, 3, 10, 30),
    "stride": (1, 2, 4),
    "outline": (0.0, 1.0),
    "corrector": (False, True),
    "mask_refinement": (False, True),
}
ERROR = "pa_mpjpe_mm"


def run_sweeps(captures: Sequence[Capture], only: Sequence[str], repeats: int) -> list[Measurement]:
    """One row per setting; each setting is run once uncounted first, see `ahoy_core.cost.sweep`."""
    body, networks = load_packaged_body(), load_networks()
    frames = sum(len(capture.frames) for capture in captures)

    def run(setting: Mapping[str, Any]) -> list[Any]:
        config = PerceiveConfig.model_validate(dict(setting))
        found = []
        for capture in captures:
            n, front = len(capture.frames), capture.cameras["front"]
            times, K, view = np.arange(n) / FPS, front.Ks[0].double().numpy(), front.viewmats[0].double().numpy()
            found.append(
                perceive(capture.frames, times, np.zeros(n, np.int32), K, body, networks, config, viewmat=view)
            )
        return found

    def error(found: list[Any]) -> dict[str, float]:
        rows = [compare(capture, body, one) for capture, one in zip(captures, found, strict=True)]
        return {name: float(np.mean([row[name] for row in rows if row[name] is not None])) for name in rows[0]}

    rows = []
    for knob in only:
        settings = [{knob: value} for value in SWEEPS[knob]]
        rows += sweep(f"perceive.{knob}", settings, run, error, repeats=repeats)
    return [_per_frame(row, frames) for row in rows]


def _per_frame(row: Measurement, frames: int) -> Measurement:
    def divided(spread: Any) -> Any:
        return spread and dataclasses.replace(
            spread, median=spread.median / frames, low=spread.low / frames, high=spread.high / frames
        )

    return dataclasses.replace(row, wall_s=divided(row.wall_s), cpu_s=divided(row.cpu_s))


def draw(rows: Sequence[Measurement], path: Path) -> None:
    """PA-MPJPE over CPU seconds a frame, log-log, a line per knob, the Pareto set ringed."""
    figure, axes = pyplot.subplots(figsize=(7, 4.5), layout="constrained")
    for name in dict.fromkeys(row.sweep for row in rows):
        mine = [row for row in rows if row.sweep == name and row.cpu_s is not None]
        axes.plot(
            [r.cpu_s.median for r in mine if r.cpu_s],
            [r.errors[ERROR] for r in mine],
            "o-",
            label=name.partition(".")[2],
        )
        for row in mine:
            if row.cpu_s:
                text = ", ".join(str(value) for value in row.setting.values())
                axes.annotate(
                    text, (row.cpu_s.median, row.errors[ERROR]), textcoords="offset points", xytext=(4, 4), size=7
                )
    front = pareto(rows, ERROR)
    axes.plot(
        [r.cpu_s.median for r in front if r.cpu_s],
        [r.errors[ERROR] for r in front],
        "o",
        ms=12,
        mfc="none",
        mec="black",
        label="Pareto",
    )
    axes.set(xscale="log", yscale="log", xlabel="CPU seconds a frame", ylabel="PA-MPJPE, mm")
    axes.legend(fontsize=8)
    figure.savefig(path, dpi=110)


def table(rows: Sequence[Measurement]) -> str:
    """The rows as a table in Markdown."""
    names = ("pa_mpjpe_visible_mm", "pa_mpjpe_hidden_mm", "mask_iou", "amodal_iou", "root_mm")
    lines = ["| knob | value | CPU-s a frame | " + " | ".join(names) + " |", "|---" * (3 + len(names)) + "|"]
    for row in rows:
        (knob, value), cpu = next(iter(row.setting.items())), row.cpu_s.median if row.cpu_s else float("nan")
        cells = [f"{row.errors[name]:.3f}" if "iou" in name else f"{row.errors[name]:.1f}" for name in names]
        lines.append(f"| {knob} | {value} | {cpu:.3f} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", type=Path)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--picture", type=Path, required=True)
    parser.add_argument("--frames", type=int, default=48, help="first frames of each capture")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--knobs", nargs="*", default=list(SWEEPS), choices=list(SWEEPS))
    arguments = parser.parse_args()
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    torch.set_num_threads(1)
    captures = [read_capture(folder).first(arguments.frames) for folder in capture_folders(arguments.captures)]
    rows = run_sweeps(captures, arguments.knobs, arguments.repeats)
    write_jsonl(arguments.json, rows)
    draw(rows, arguments.picture)
    print(table(rows))


if __name__ == "__main__":
    main()
