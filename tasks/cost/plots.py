"""Work-precision diagrams: error over CPU seconds, both logarithmic, a line a knob, the Pareto set ringed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib

from ahoy_core.cost.sweep import Measurement, pareto
from tasks.cost.summary import shown


def draw(rows: Sequence[Measurement], error: str, unit: str, path: Path, minutes: bool = False) -> bool:
    """Draw one diagram.

    Args:
        rows: of one stage, a row a setting.
        error: which of their errors.
        unit: of it.
        path: of the PNG.
        minutes: time in minutes a video instead of seconds.

    Returns:
        Whether there was anything to draw.
    """
    matplotlib.use("agg")
    from matplotlib import pyplot

    there = [row for row in rows if row.cpu_s is not None and row.errors.get(error, 0) > 0]
    if not there:
        return False
    scale = 60.0 if minutes else 1.0

    def at(some: Sequence[Measurement]) -> tuple[list[float], list[float]]:
        return [row.cpu_s.median / scale for row in some if row.cpu_s], [row.errors[error] for row in some]

    figure, axes = pyplot.subplots(figsize=(7.5, 4.8), layout="constrained")
    for name in dict.fromkeys(row.sweep for row in there):
        mine = sorted((row for row in there if row.sweep == name), key=lambda row: row.cpu_s.median if row.cpu_s else 0)
        axes.plot(*at(mine), "o-", ms=4, lw=1, label=name.partition(".")[2])
        for row, x, y in zip(mine, *at(mine), strict=True):
            axes.annotate(shown(row.setting), (x, y), textcoords="offset points", xytext=(4, 4), size=7)
    axes.plot(*at(pareto(there, error)), "o", ms=11, mfc="none", mec="black", label="Pareto set")
    axes.set(
        xscale="log",
        yscale="log",
        xlabel="CPU minutes a video" if minutes else "CPU seconds",
        ylabel=f"{error.replace('_', ' ')}, {unit}",
    )
    for axis, values in zip((axes.xaxis, axes.yaxis), at(there), strict=True):
        axis.set_major_formatter("{x:g}")
        # Less than a decade has one power of ten at most, and no number beside it to read the axis by.
        if max(values) < 10 * min(values):
            axis.set_minor_formatter("{x:.4g}")
    axes.legend(fontsize=8)
    axes.grid(which="both", lw=0.3)
    figure.savefig(path, dpi=100)
    pyplot.close(figure)
    return True
