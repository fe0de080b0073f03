"""The page on what accuracy costs: tables, diagrams and omissions, made from the rows alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ahoy_core.cost.sweep import Measurement, Spread, pareto
from tasks.cost.change import Change
from tasks.cost.declared import END_TO_END, END_TO_END_KNOBS, END_TO_END_REFERENCE, STAGE_SWEEPS
from tasks.cost.errors import SHARPNESS_DB, psnr
from tasks.cost.plots import draw
from tasks.cost.summary import DRAWN, alike, least_gains, of_sweep, omissions, over_captures, shown

HEAD = """# What accuracy costs in time

This page is made by a command; change the rows, not the page. It holds what was measured and nothing else; what is
missing stands under [omissions](#omissions).

    ahoy cost --dataset CAPTURES --out OUT --page docs/cost.md --measured ahoy_core/assets/cost.json

Each knob is changed alone, the others as the base settings say ({base}). Seconds are CPU seconds of the whole process,
memory is the most that the process held while it ran (it keeps what earlier settings took, so that small differences
say nothing); errors are means over the captures ({captures}), *range* is the lowest to the highest of all *runs*, which
are those of all captures. *Pareto*: no other row of the table is both cheaper and better in the first error. Error is
drawn over time, both logarithmic. What is swept, and against what, is declared in `tasks/cost/declared.py`. Machine:
{machine}.
"""

_FRONTS = {"PSNR": "rmse", "perceptual": "perceptual"}
_WHOLE_WORDS = (
    "The columns of stages are their CPU seconds; SSIM and perceptual distance (less is better) are means of novel "
    "views and novel poses. *Least gain* is what a budget counts: dB over the base on the capture where that is least, "
    f"a hundredth of perceptual distance taken as {SHARPNESS_DB / 100:.1f} dB; below zero the row is worse on one at "
    "least, whatever the means say. A preset before a knob is the one that it was changed round. The last column says "
    "in which figures no other row is both cheaper and better."
)


def write_page(rows: Sequence[Measurement], facts: Mapping[str, Any], page: Path) -> list[Path]:
    """Write the page and the diagrams beside it.

    Args:
        rows: as measured, a row a capture.
        facts: `base`, `machine`: what else the head says; `preset`: of the base.
        page: where.

    Returns:
        Everything that was written.
    """
    page.parent.mkdir(parents=True, exist_ok=True)
    means = over_captures(rows)
    captures = ", ".join(sorted({row.capture for row in rows})) or "none"
    parts = [HEAD.format(base=facts["base"], captures=captures, machine=facts["machine"])]
    written = [page]
    for name in (END_TO_END, *STAGE_SWEEPS):
        mine = of_sweep(means, name)
        error, unit = DRAWN[name]
        picture = page.parent / f"{page.stem}-{name}.png"
        parts += [f"## {name.capitalize()}", _said_of(name)]
        if draw(alike(mine), error, unit, picture, minutes=name == END_TO_END):
            written.append(picture)
            parts.append(f"![{error.replace('_', ' ')} over CPU time]({picture.name})")
        parts.append(_whole_table(mine, rows, facts["preset"]) if name == END_TO_END else _table(mine, error))
    parts += ["## Omissions", "\n".join(f"- {line}" for line in omissions(rows, facts["preset"]))]
    page.write_text("\n\n".join(parts) + "\n", encoding="utf-8")
    return written


def _said_of(name: str) -> str:
    if name == END_TO_END:
        return (
            f"Whole runs, from the video to the report, against {END_TO_END_REFERENCE}. Minutes are CPU minutes, each "
            "stage's bill from when it was made."
        )
    return f"One stage on saved inputs, against {STAGE_SWEEPS[name].reference}."


def _table(rows: Sequence[Measurement], error: str) -> str:
    if not rows:
        return "Not measured yet."
    front = {id(row) for row in pareto(rows, error)}
    names = [error, *(name for name in rows[0].errors if name != error)]
    lines = [_line(["knob", "value", "CPU-s", "range", "runs", "MB", *(name.replace("_", " ") for name in names), ""])]
    lines.append(_line(["---"] * (len(names) + 7)))
    for row in rows:
        figures = [_figure(row.errors.get(name)) for name in names]
        mark = "Pareto" if id(row) in front else ""
        cells = [row.sweep.partition(".")[2], shown(row.setting), *_time(row.cpu_s), _whole(row.peak_mb), *figures]
        lines.append(_line([*cells, mark]))
    return "\n".join(lines)


def _whole_table(rows: Sequence[Measurement], measured: Sequence[Measurement], base: str) -> str:
    """The table of whole runs.

    Args:
        rows: means over captures.
        measured: a row a capture.
        base: preset that rows are round unless they name another.
    """
    if not rows:
        return "Not measured yet."
    gains = {name: least_gains(measured, base, name) for name in (base, *END_TO_END_KNOBS)}
    comparable = alike(rows)
    fronts = {word: {id(row) for row in pareto(comparable, error)} for word, error in _FRONTS.items()}
    stages = [name for name in rows[0].parts if any(row.parts.get(name, 0) >= 0.5 for row in rows)]
    words = ["PSNR, dB", "novel view", "novel pose", "head", "SSIM", "perceptual"]
    head = ["setting", "value", "CPU minutes", "range", "runs", "least gain", *words, "MB", *stages, "Pareto"]
    lines = [_line(head), _line(["---"] * len(head))]
    for row in rows:
        scores = [f"{psnr(row.errors[name]):.2f}" for name in ("rmse", "view_rmse", "pose_rmse", "head_rmse")]
        scores.append(f"{1 - row.errors['ssim_loss']:.3f}" if "ssim_loss" in row.errors else "-")
        scores.append(_figure(row.errors.get("perceptual")))
        mark = ", ".join(word for word, front in fronts.items() if id(row) in front)
        seconds = [f"{row.parts.get(name, 0.0):.1f}" for name in stages]
        value = shown(row.setting) + ("" if row in comparable else f" ({row.capture} alone)")
        change = Change.of(row.setting, base)
        gained = gains.get(change.preset, {}).get(change.knob, {}).get(change.value)
        least = "-" if gained is None else f"{gained:+.2f}"
        said = row.sweep.partition(".")[2].replace(f"{change.preset}.", f"{change.preset}: ", 1)
        cells = [said, value, *_time(row.cpu_s, 60), least, *scores, _whole(row.peak_mb), *seconds]
        lines.append(_line([*cells, mark]))
    lines += ["", _WHOLE_WORDS]
    return "\n".join(lines)


def _time(spread: Spread | None, unit_s: float = 1.0) -> tuple[str, str, str]:
    """Median, range, and how many runs they are of, those of all captures together."""
    if spread is None:
        return "-", "-", "0"
    low, high = (f"{seconds / unit_s:.2f}" for seconds in (spread.low, spread.high))
    return f"{spread.median / unit_s:.2f}", f"{low}-{high}" if spread.repeats > 1 else low, str(spread.repeats)


def _whole(spread: Spread | None) -> str:
    return "-" if spread is None else f"{spread.median:.0f}"


def _figure(value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:.3f}" if abs(value) < 1 else f"{value:.2f}"


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"
