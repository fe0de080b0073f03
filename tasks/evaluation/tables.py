"""Scores as tables in Markdown: one table a protocol id, reference rows in each, paired differences below."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ahoy_core.metrics.compare import (
    LEAST_CAPTURES,
    Difference,
    Row,
    capture_means,
    check_one_protocol,
    interval,
    paired_difference,
)
from ahoy_core.metrics.score import REFERENCES, REGIONS

METRICS = ("psnr", "ssim", "perceptual", "iou")
_DIGITS = {"psnr": 2, "ssim": 3, "perceptual": 3, "iou": 3}
BASE = "full"
Spread = tuple[float, tuple[float, float] | None, Sequence[float]]
"""Mean, interval (None with few captures), and the mean of each capture."""


def one_table(rows: Sequence[Row]) -> str:
    """Configurations by metric, means over captures of means over pictures, and PSNR by capture.

    Raises:
        ValueError: rows of several protocol ids.
    """
    identity = check_one_protocol(rows)
    captures = sorted({row["capture"] for row in rows})
    net = next((row["perceptual_name"] for row in rows if row["perceptual_name"]), "perceptual")
    names = ["configuration", "input", "PSNR", "SSIM", net, "IoU", *(f"PSNR {name}" for name in captures)]
    lines = [f"`{identity}`", "", _line(names), _line(["---"] * len(names))]
    for config, setting in _configs(rows):
        own = [row for row in rows if row["config"] == config and row["input_setting"] == setting]
        means = {metric: capture_means(own, metric) for metric in METRICS}
        cells = [_mean(means[metric], _DIGITS[metric]) for metric in METRICS]
        by_capture = [_number(means["psnr"].get(name), 2) for name in captures]
        lines.append(_line([config, setting, *cells, *by_capture]))
    return "\n".join(lines)


def tables(rows: Sequence[Row]) -> str:
    """Every protocol, region by region; rows of different protocol ids get tables of their own."""
    parts: list[str] = []
    for protocol in dict.fromkeys(row["protocol"] for row in rows):
        parts.append(f"## {protocol}")
        for region in REGIONS:
            chosen = [row for row in rows if row["protocol"] == protocol and row["region"] == region]
            for identity in sorted({row["protocol_id"] for row in chosen}):
                same = [row for row in chosen if row["protocol_id"] == identity]
                parts += [f"### {protocol}, {region}", one_table(same)]
                if region in ("box", "head") and (found := differences(same)):
                    parts.append(_differences(found))
    return "\n\n".join(parts)


def differences(rows: Sequence[Row], metric: str = "psnr") -> list[Difference]:
    """Every configuration that is no reference against the full one, where both were scored."""
    names = [name for name, _ in _configs(rows)]
    if BASE not in names:
        return []
    others = [name for name in dict.fromkeys(names) if name != BASE and name not in REFERENCES]
    found = [paired_difference(rows, name, BASE, metric) for name in others]
    return [one for one in found if one.pairs]


def _differences(found: Sequence[Difference]) -> str:
    captures = sorted({name for one in found for name in one.by_capture})
    enough = any(one.interval for one in found)
    how = (
        "95% interval of a bootstrap that draws captures as wholes"
        if enough
        else f"fewer than {LEAST_CAPTURES} captures: no interval, each capture for itself"
    )
    lines = [f"PSNR minus that of `{BASE}`, picture by picture ({how}):", ""]
    names = ["configuration", "mean", *(["interval"] if enough else []), *captures, "pictures"]
    lines += [_line(names), _line(["---"] * len(names))]
    for one in found:
        between = [f"{one.interval[0]:+.2f} to {one.interval[1]:+.2f}" if one.interval else "-"] if enough else []
        cells = [_signed(one.by_capture.get(name)) for name in captures]
        lines.append(_line([one.config, _signed(one.mean), *between, *cells, str(one.pairs)]))
    return "\n".join(lines)


def spread(rows: Sequence[Row], metric: str = "psnr") -> dict[str, Spread]:
    """Spread by configuration, for the chart."""
    found: dict[str, Spread] = {}
    for config, setting in _configs(rows):
        own = [row for row in rows if row["config"] == config and row["input_setting"] == setting]
        means = capture_means(own, metric)
        if means:
            values = list(means.values())
            label = config if setting == "video" else f"{config} ({setting})"
            found[label] = float(np.mean(values)), interval(values), values
    return found


def _configs(rows: Sequence[Row]) -> list[tuple[str, str]]:
    """Configurations with their input setting, in the order of the rows, references last."""
    found = list(dict.fromkeys((row["config"], row["input_setting"]) for row in rows))
    return [pair for pair in found if pair[0] not in REFERENCES] + [pair for pair in found if pair[0] in REFERENCES]


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _mean(means: Mapping[str, float], digits: int) -> str:
    return _number(float(np.mean(list(means.values()))) if means else None, digits)


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _signed(value: float | None) -> str:
    return "-" if value is None else f"{value:+.2f}"
