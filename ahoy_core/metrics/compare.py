"""Scores by configuration: means, and paired differences under a bootstrap by capture: frames are not independent."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

Row = Mapping[str, Any]
LEAST_CAPTURES = 5  # fewer clusters give a bootstrap nothing to draw from
REPEATS = 10_000
COVERED = 0.95
_PAIR = ("protocol", "region", "camera", "frame")


def check_one_protocol(rows: Iterable[Row]) -> str:
    """The protocol id that all rows share.

    Raises:
        ValueError: there are several: such rows can't stand in one table.
    """
    ids = sorted({row["protocol_id"] for row in rows})
    if len(ids) != 1:
        listed = "\n  ".join(ids) or "none"
        raise ValueError(
            f"expected rows of one protocol id in a table, got {len(ids)}:\n  {listed}\nscore them under one protocol "
            "(same size, poses, perceptual net, versions), or make a table each"
        )
    return ids[0]


def capture_means(rows: Iterable[Row], metric: str) -> dict[str, float]:
    """Mean over the frames and cameras of each capture; captures without a value are left out.

    Raises:
        ValueError: rows of several protocol ids.
    """
    rows = list(rows)
    check_one_protocol(rows)
    values: dict[str, list[float]] = defaultdict(list)
    for row in rows:
        if row[metric] is not None:
            values[row["capture"]].append(float(row[metric]))
    return {capture: float(np.mean(found)) for capture, found in sorted(values.items())}


@dataclass(frozen=True)
class Difference:
    """A configuration against another, frame by frame.

    Attributes:
        config, base: the mean is that of `config` minus that of `base`.
        metric: of which.
        by_capture: mean difference of each capture's pairs.
        mean: over captures; None without a pair.
        interval: that covers 95% of the bootstrap, captures drawn as wholes; None with fewer than five.
        pairs: how many pictures both have.
    """

    config: str
    base: str
    metric: str
    by_capture: Mapping[str, float] = field(default_factory=dict)
    mean: float | None = None
    interval: tuple[float, float] | None = None
    pairs: int = 0


def paired_difference(rows: Sequence[Row], config: str, base: str, metric: str, seed: int = 0) -> Difference:
    """Difference of two configurations over the pictures that both have.

    Args:
        rows: of one protocol id and region.
        config: name of the one.
        base: name of the other.
        metric: column.
        seed: of the bootstrap.

    Raises:
        ValueError: rows of several protocol ids.
    """
    check_one_protocol(rows)
    values: dict[str, dict[tuple[Any, ...], float]] = {config: {}, base: {}}
    for row in rows:
        if row["config"] in values and row[metric] is not None:
            values[row["config"]][(row["capture"], *(row[name] for name in _PAIR))] = float(row[metric])
    by_capture: dict[str, list[float]] = defaultdict(list)
    for pair in sorted(values[config].keys() & values[base].keys()):
        by_capture[pair[0]].append(values[config][pair] - values[base][pair])
    means = {capture: float(np.mean(found)) for capture, found in by_capture.items()}
    if not means:
        return Difference(config, base, metric)
    pairs = sum(map(len, by_capture.values()))
    drawn = np.array(list(means.values()))
    return Difference(config, base, metric, means, float(drawn.mean()), interval(drawn, seed), pairs)


def interval(values: Sequence[float] | np.ndarray, seed: int = 0) -> tuple[float, float] | None:
    """Bootstrap interval of the mean of one value a capture; None where there are too few captures."""
    drawn = np.asarray(values, dtype=np.float64)
    if len(drawn) < LEAST_CAPTURES:
        return None
    rng = np.random.default_rng(seed)
    means = drawn[rng.integers(len(drawn), size=(REPEATS, len(drawn)))].mean(1)
    low, high = np.quantile(means, ((1 - COVERED) / 2, (1 + COVERED) / 2))
    return float(low), float(high)
