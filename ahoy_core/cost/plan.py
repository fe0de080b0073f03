"""Planning arithmetic: how long N videos take on so many workers and slots, simulated from measured runs.

The measured videos are the model: each simulated video is one of them, drawn with replacement, with all its attempts,
their stages and what they failed at, so that long videos are long in every stage and failures as frequent as they were.
Each repeat first draws the pool itself anew (a bootstrap), so that the interval also says how little a small ledger
tells.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ahoy_core.cost.simulate import WORKER, Fleet, MeasuredVideo, Simulated, Use, simulate

INTERVAL = (0.05, 0.95)
# Repeats that give a steady interval for small batches; large ones vary less and cost more.
_MOST_REPEATS, _LEAST_REPEATS, _VIDEOS_IN_ALL = 200, 10, 40_000


@dataclass(frozen=True)
class Estimate:
    """Median over the repeats, and the interval that holds nine tenths of them."""

    median: float
    low: float
    high: float

    @classmethod
    def of(cls, values: Sequence[float]) -> Estimate:
        """Summarise at least one value."""
        low, median, high = np.quantile(np.asarray(values, dtype=np.float64), (INTERVAL[0], 0.5, INTERVAL[1]))
        return cls(float(median), float(low), float(high))


@dataclass(frozen=True)
class WhatIf:
    """What one more of a resource buys."""

    resource: str
    capacity: int
    makespan_s: Estimate
    saved_s: float
    cost: float


@dataclass(frozen=True)
class Plan:
    """What to expect of a batch.

    Attributes:
        makespan_s: from the first start to the last end.
        cost: of the machines over that time.
        uses: resource -> mean over the repeats.
        bottleneck: the resource that is busiest.
        attempts, failed: videos' attempts, and videos that never got through, mean over the repeats.
        what_if: one more of each resource, what saves most first.
        repeats: how many batches were simulated.
    """

    videos: int
    makespan_s: Estimate
    cost: Estimate
    uses: Mapping[str, Use]
    bottleneck: str
    attempts: float
    failed: float
    what_if: tuple[WhatIf, ...]
    repeats: int

    def to_json(self) -> dict[str, Any]:
        """Plain JSON types."""
        return {"schema_version": 1, **dataclasses.asdict(self)}


def plan(
    measured: Sequence[MeasuredVideo], fleet: Fleet, videos: int, *, repeats: int | None = None, seed: int = 0
) -> Plan:
    """Simulate a batch of `videos` on `fleet`, many times.

    Args:
        measured: videos that went through, or failed for good, before; at least one with an attempt.
        fleet: workers, slots, prices.
        videos: how many.
        repeats: how many batches; as many as are cheap by default.
        seed: of the draws; the same for every fleet, so that fleets are compared on the same videos.

    Raises:
        ValueError: nothing was measured, or no videos are asked for.
    """
    pool = [video for video in measured if video.attempts]
    if not pool or videos < 1:
        raise ValueError(
            f"plan: expected measured videos and at least one video to plan, got {len(pool)} and {videos}; "
            "run a small batch first, its ledger is what plans are made from"
        )
    repeats = repeats or max(_LEAST_REPEATS, min(_MOST_REPEATS, _VIDEOS_IN_ALL // videos))
    runs = _runs(pool, fleet, videos, repeats, seed)
    makespans = [run.makespan_s for run in runs]
    estimate = Estimate.of(makespans)
    uses = {name: _mean_use([run.uses[name] for run in runs]) for name in runs[0].uses}
    return Plan(
        videos=videos,
        makespan_s=estimate,
        cost=Estimate(*(fleet.cost(value) for value in (estimate.median, estimate.low, estimate.high))),
        uses=uses,
        bottleneck=max(uses, key=lambda name: uses[name].utilisation),
        attempts=float(np.mean([run.attempts for run in runs])),
        failed=float(np.mean([run.failed for run in runs])),
        what_if=_what_if(pool, fleet, makespans, videos, seed),
        repeats=repeats,
    )


def _runs(pool: Sequence[MeasuredVideo], fleet: Fleet, videos: int, repeats: int, seed: int) -> list[Simulated]:
    runs = []
    for repeat in range(repeats):
        rng = np.random.default_rng((seed, repeat))
        drawn = rng.integers(len(pool), size=len(pool))
        runs.append(simulate([pool[drawn[i]] for i in rng.integers(len(pool), size=videos)], fleet))
    return runs


def _mean_use(uses: Sequence[Use]) -> Use:
    means = (float(np.mean([getattr(use, name) for use in uses])) for name in ("utilisation", "wait_s", "waiting"))
    return Use(uses[0].capacity, *means)


def _what_if(
    pool: Sequence[MeasuredVideo], fleet: Fleet, makespans: Sequence[float], videos: int, seed: int
) -> tuple[WhatIf, ...]:
    # A quarter of the repeats: the draws are the same, so that differences are much steadier than the times.
    repeats = max(_LEAST_REPEATS // 2, len(makespans) // 4)
    found = []
    for resource in (WORKER, *fleet.slots):
        grown = fleet.grown(resource)
        after = [run.makespan_s for run in _runs(pool, grown, videos, min(repeats, len(makespans)), seed)]
        saved = float(np.mean([before - now for before, now in zip(makespans, after, strict=False)]))
        capacity = grown.workers if resource == WORKER else grown.slots[resource]
        estimate = Estimate.of(after)
        found.append(WhatIf(resource, capacity, estimate, saved, grown.cost(estimate.median)))
    return tuple(sorted(found, key=lambda option: -option.saved_s))
