"""The simulation agrees with what can be computed by hand, and plans say what their ledger can know."""

from __future__ import annotations

import itertools
import json
import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from ahoy_core.cost.plan import plan
from ahoy_core.cost.simulate import Fleet, MeasuredAttempt, MeasuredVideo, simulate

SECONDS = st.floats(0.0, 100.0)


def video(*steps: tuple[str, float], overhead_s: float = 0.0) -> MeasuredVideo:
    return MeasuredVideo((MeasuredAttempt(steps, overhead_s),))


def total(one: MeasuredVideo) -> float:
    return sum(attempt.overhead_s + sum(s for _, s in attempt.steps) for attempt in one.attempts)


ATTEMPTS = st.builds(
    lambda a, b, overhead, done: MeasuredAttempt((("fetch", a), ("fit", b)), overhead, done),
    SECONDS, SECONDS, SECONDS, st.booleans(),
)  # fmt: skip
BATCHES = st.lists(
    st.builds(MeasuredVideo, st.lists(ATTEMPTS, min_size=1, max_size=3).map(tuple)), min_size=1, max_size=9
)


@given(BATCHES)
@example([video(("fetch", 0.0), overhead_s=2e-309)])
def test_one_worker_takes_the_sum_and_is_never_idle(batch: list[MeasuredVideo]) -> None:
    run = simulate(batch, Fleet(1))
    assert run.makespan_s == pytest.approx(sum(map(total, batch)))
    assert run.uses["worker"].utilisation == pytest.approx(1.0 if run.makespan_s > 0 else 0.0)
    assert run.attempts == sum(len(one.attempts) for one in batch)
    assert run.failed == sum(not one.attempts[-1].done for one in batch)


@given(BATCHES)
def test_as_many_workers_as_videos_take_as_long_as_the_longest(batch: list[MeasuredVideo]) -> None:
    run = simulate(batch, Fleet(len(batch)))
    assert run.makespan_s == pytest.approx(max(map(total, batch)))
    assert run.uses["worker"].wait_s == 0


@given(BATCHES)
def test_a_single_slot_passes_one_stage_at_a_time_however_many_workers_wait(batch: list[MeasuredVideo]) -> None:
    run = simulate(batch, Fleet(len(batch), {"gpu": 1}, {"fetch": "gpu", "fit": "gpu"}))
    held = sum(seconds for one in batch for attempt in one.attempts for _, seconds in attempt.steps)
    longest = max(map(total, batch))
    assert max(held, longest) <= run.makespan_s + 1e-9
    assert run.uses["gpu"].utilisation * run.makespan_s == pytest.approx(held)
    if all(attempt.overhead_s == 0 for one in batch for attempt in one.attempts):
        assert run.makespan_s == pytest.approx(held), "nothing else to do: the slot is never idle"


@given(st.lists(SECONDS, min_size=1, max_size=12), st.integers(1, 5))
def test_any_number_of_workers_keeps_the_bounds_of_list_scheduling(times: list[float], workers: int) -> None:
    batch = [video(("fit", seconds)) for seconds in times]
    makespan = simulate(batch, Fleet(workers)).makespan_s
    share, longest = sum(times) / workers, max(times)
    # Graham 1966: no worker is idle while a video waits.
    assert max(share, longest) - 1e-9 <= makespan <= share + longest * (1 - 1 / workers) + 1e-9
    assert simulate(batch, Fleet(workers + 1)).makespan_s <= makespan + 1e-9


def test_waiting_for_a_slot_is_that_of_the_m_d_1_queue() -> None:
    rng, seconds, load = np.random.default_rng(3), 1.0, 0.6
    arrivals = np.cumsum(rng.exponential(seconds / load, 8_000))
    batch = [video(("fit", seconds), overhead_s=float(at)) for at in arrivals]
    run = simulate(batch, Fleet(len(batch), {"gpu": 1}, {"fit": "gpu"}))
    # Pollaczek-Khinchine with constant service. 8,000 correlated waits leave about 5% of noise; a queue with
    # exponential service would wait twice as long.
    assert run.uses["gpu"].wait_s == pytest.approx(load * seconds / (2 * (1 - load)), rel=0.15)
    assert run.uses["gpu"].utilisation == pytest.approx(load, rel=0.05)
    assert run.uses["gpu"].waiting == pytest.approx(run.uses["gpu"].wait_s * load / seconds, rel=0.05), "Little's law"


POOL = [video(("fetch", s), ("fit", 2 * s)) for s in np.random.default_rng(0).gamma(4.0, 1.0, 50)]


def test_the_interval_holds_what_independent_draws_of_the_same_kind_give() -> None:
    made = plan(POOL, Fleet(4), 60, repeats=100)
    rng = np.random.default_rng(9)
    draws = [[POOL[i] for i in rng.integers(len(POOL), size=60)] for _ in range(60)]
    inside = sum(made.makespan_s.low <= simulate(draw, Fleet(4)).makespan_s <= made.makespan_s.high for draw in draws)
    # Nine tenths and more, as the interval also covers what the pool does not know; 45 of 60 is 4 sigma below 0.9.
    assert inside >= 45
    assert made.makespan_s.low < made.makespan_s.median < made.makespan_s.high


def test_a_larger_ledger_and_a_larger_batch_are_known_better() -> None:
    def width(pool: list[MeasuredVideo], videos: int) -> float:
        made = plan(pool, Fleet(2), videos, repeats=60).makespan_s
        return (made.high - made.low) / made.median

    assert width(POOL, 200) < 0.7 * width(POOL, 10)
    assert width(POOL, 200) < 0.7 * width(POOL[:6], 200)


def test_failures_and_retries_are_as_frequent_as_they_were() -> None:
    failed = MeasuredAttempt((("fetch", 1.0),), done=False)
    pool = [
        video(("fetch", 1.0)),
        MeasuredVideo((failed, *video(("fetch", 1.0)).attempts)),
        MeasuredVideo((failed,)),
        video(("fetch", 1.0)),
    ]
    made = plan(pool, Fleet(3), 400, repeats=40)
    # A quarter of the videos needs a second attempt, a quarter fails; the pool of four is drawn anew in each repeat,
    # which moves the mean of 40 repeats by sqrt(3/16/4/40) = 0.034.
    assert made.attempts / 400 == pytest.approx(1.25, abs=0.14)
    assert made.failed / 400 == pytest.approx(0.25, abs=0.14)
    assert made.makespan_s.median == pytest.approx(made.attempts / 3, rel=0.1)


def test_the_bottleneck_is_named_and_one_more_of_it_buys_most() -> None:
    fleet = Fleet(6, {"gpu": 1, "download": 3}, {"fit": "gpu", "fetch": "download"}, per_machine=2, price_per_hour=3.6)
    made = plan(POOL, fleet, 80, repeats=20)
    assert made.bottleneck == "gpu" == made.what_if[0].resource
    assert made.uses["gpu"].utilisation > 0.95 and made.what_if[0].capacity == 2
    assert made.what_if[0].saved_s == pytest.approx(made.makespan_s.median / 2, rel=0.15), "it halves the time"
    by_name = {option.resource: option for option in made.what_if}
    assert abs(by_name["worker"].saved_s) < 0.02 * made.makespan_s.median, "more workers only wait"
    # Three machines at 3.6 an hour, then four.
    assert made.cost.median == pytest.approx(made.makespan_s.median * 3 / 1000)
    assert made.uses["worker"].utilisation < 0.5, "held, but waiting for the gpu"
    assert by_name["worker"].cost == pytest.approx(by_name["worker"].makespan_s.median * 4 / 1000)


def test_plans_are_repeatable_and_plain() -> None:
    first, second, other = (plan(POOL, Fleet(2), 10, repeats=5, seed=seed) for seed in (1, 1, 2))
    assert first == second != other
    assert json.loads(json.dumps(first.to_json(), allow_nan=False))["videos"] == 10


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: plan([], Fleet(1), 1), "run a small batch first"),
        (lambda: plan([MeasuredVideo(())], Fleet(1), 1), "run a small batch first"),
        (lambda: plan(POOL, Fleet(1), 0), "at least one video"),
        (lambda: Fleet(0), "at least one worker"),
        (lambda: Fleet(1, {"gpu": 0}), "at least one worker"),
        (lambda: Fleet(1, {"gpu": 1}, {"fit": "gpus"}), r"no slots; have \['gpu'\]"),
    ],
)
def test_what_cannot_be_planned_is_refused(make: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()  # type: ignore[operator]


def test_a_batch_without_any_time_takes_none() -> None:
    made = plan([video(("fetch", 0.0))], Fleet(2), 3, repeats=3)
    assert made.makespan_s.median == 0 and all(math.isfinite(use.utilisation) for use in made.uses.values())


def test_attempts_of_a_video_follow_each_other_with_a_pause() -> None:
    tries = tuple(MeasuredAttempt((("fetch", 1.0),), done=done) for done in (False, False, True))
    assert simulate([MeasuredVideo(tries)], Fleet(5, pause_s=10.0)).makespan_s == pytest.approx(23.0)
    crowded = [MeasuredVideo(tries), *itertools.repeat(video(("fetch", 1.0)), 7)]
    assert simulate(crowded, Fleet(1)).makespan_s == pytest.approx(10.0), "a pause keeps no worker"
