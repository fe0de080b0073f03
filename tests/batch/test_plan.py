"""Which videos are due, for every pair of what the ledger and Prefect can say."""

from __future__ import annotations

import pytest

from flows.batch.plan import Plan, SeenRun, Work, died_silently, plan
from storage_schema.video_status import VideoStatus


def _record(state: str = "waiting", attempt: int = 0, run_id: str | None = None) -> VideoStatus:
    return VideoStatus("v", "/v.mp4", state, attempt, run_id)


def _run(state: str, attempt: int = 1) -> SeenRun:
    return SeenRun("v", attempt, state, f"id{attempt}")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("record", "runs", "due"),
    [
        (_record(), [], [1]),
        (_record("waiting", 1, ""), [], [1]),  # announced, and the feeder was killed before it created the run
        (_record("waiting", 2, ""), [_run("crashed")], [2]),
        (_record("running", 1, "r"), [_run("crashed")], [2]),
        (_record("running", 1, "r"), [], [2]),  # the server lost its database
        (_record("crashed", 1, "r"), [_run("crashed")], [2]),
        (_record("crashed", 3, "r"), [_run("crashed", 3)], []),  # often enough
        (_record("failed", 1, "r"), [_run("failed")], []),
        (_record("done", 1, "r"), [_run("crashed")], []),  # done, and killed before it could say so to Prefect
        (_record("done", 1, "r"), [], []),
        (_record("waiting", 1, ""), [_run("cancelled")], []),
        (_record("cancelled", 1, ""), [], []),
    ],
)
def test_a_video_that_is_not_under_way(record: VideoStatus, runs: list[SeenRun], due: list[int]) -> None:
    made = plan([record], runs, tries=3)
    assert [work.attempt for work in made.due] == due and not made.live


def test_a_live_run_is_watched_and_not_doubled() -> None:
    made = plan([_record("running", 2, "r")], [_run("crashed"), _run("live", 2)], tries=3)
    assert made == Plan([], {"id2": Work("v", 2)}, {"v": 3})


@pytest.mark.parametrize("state", ["done", "failed", "crashed"])
def test_a_chosen_video_is_made_again_whatever_became_of_it(state: str) -> None:
    records = [_record(state, 2, "r"), VideoStatus("w", "/w.mp4", "waiting")]
    made = plan(records, [_run(state, 2)], tries=3, chosen={"v"})
    assert made.due == [Work("v", 3)] and made.last_attempt == {"v": 5}


def test_a_chosen_video_that_waits_announced_keeps_its_number() -> None:
    assert plan([_record("cancelled", 2, "")], [_run("cancelled", 1)], 3, {"v"}).due == [Work("v", 2)]
    assert plan([_record("cancelled", 2, "")], [_run("cancelled", 2)], 3, {"v"}).due == [Work("v", 3)]


def test_planning_twice_gives_the_same_attempts() -> None:
    """Two feeders that start at once create the same runs, under the same keys."""
    records, runs = [_record("crashed", 1, "r")], [_run("crashed")]
    assert plan(records, runs, 3).due == plan(records, runs, 3).due == [Work("v", 2)]


def test_crashes_lead_to_so_many_tries_and_no_more() -> None:
    made = plan([_record()], [], tries=3)
    work, tries = made.due[0], 1
    while (following := made.after_crash(work)) is not None:
        work, tries = following, tries + 1
    assert tries == 3


def test_who_is_at_work_in_the_ledger_alone_has_died() -> None:
    at_work = [_record("running", 1, "r")]
    assert died_silently(at_work, []) == at_work == died_silently(at_work, [_run("crashed")])
    assert died_silently(at_work, [_run("live")]) == []
