"""The fold of a batch's rows says what happened, whatever the clocks of the machines said."""

from __future__ import annotations

import json
import random
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from storage_schema.batches import BatchEntry, BatchManifest, cancel_batch, submit
from storage_schema.schemas import ATTEMPT_STATES, TABLES
from storage_schema.status import VIDEO_STATES, BatchStatus, batch_status, fold, select
from storage_schema.store import ArtifactStore
from storage_schema.tables import Tables

NOW = datetime(2026, 1, 2, tzinfo=UTC)
STAGES = ("ingest", "perceive", "coarse")


def attempt(video: str, state: str, number: int = 1, seq: int = 0, **more: Any) -> dict[str, Any]:
    key = {"video_id": video, "run_id": f"{video}{number}", "attempt_number": number, "seq": seq}
    return {**key, "state": state, "at": NOW, **more}


def stage(video: str, name: str, state: str = "done", number: int = 1, seq: int = 0, **more: Any) -> dict[str, Any]:
    row = {"video_id": video, "run_id": f"{video}{number}", "stage": name, "stage_version": 1, "state": state}
    return {**row, "attempt_number": number, "seq": seq, "started_at": NOW, "wall_s": 2.0, "cpu_s": 1.0, **more}


def table(name: str, rows: list[dict[str, Any]]) -> pa.Table:
    return pa.Table.from_pylist(rows, schema=TABLES[name].columns)


def manifest(*videos: str) -> BatchManifest:
    made = BatchManifest.of("b", [BatchEntry(video, f"{video}.mp4") for video in videos])
    return replace(made, created_at="2026-01-01T00:00:00.000+00:00")


def folded(videos: str, attempts: list[dict[str, Any]], rows: list[dict[str, Any]] = [], **how: Any) -> BatchStatus:  # noqa: B006
    how = {"stages": STAGES, **how}
    return fold(manifest(*videos), table("attempts", attempts), table("stages", rows), **how)


def finished(video: str, number: int = 1, wall: float = 2.0) -> list[dict[str, Any]]:
    return [stage(video, name, number=number, seq=i, wall_s=wall) for i, name in enumerate(STAGES)]


def test_videos_are_counted_by_state_and_by_stage() -> None:
    status = folded(
        "abcdefg",
        [
            *(attempt("a", state, seq=i) for i, state in enumerate(("scheduled", "running", "done"))),
            attempt("b", "running", stage="perceive"),
            attempt("c", "failed", error_class="ValueError", stage="ingest", error_message="no person"),
            attempt("d", "crashed"),
            attempt("e", "cancelled"),
            attempt("f", "scheduled"),
        ],
        [*finished("a"), stage("b", "ingest"), stage("c", "ingest", "failed")],
    )
    assert dict(status.videos) == {"waiting": 2, "running": 1, "done": 1, "failed": 1, "crashed": 1, "cancelled": 1}
    assert status.stages["ingest"] == {"done": 2, "failed": 1, "waiting": 3}
    assert status.stages["perceive"] == {"done": 1, "running": 1, "waiting": 3}
    assert sum(status.videos.values()) == status.total == 7
    assert [(e.error_class, e.count, e.example_video, e.example_message) for e in status.errors] == [
        ("Crashed", 1, "d", ""),
        ("ValueError", 1, "c", "no person"),
    ]


def test_a_rerun_counts_from_the_moment_it_is_scheduled_and_hides_the_error_before_it() -> None:
    rows = [stage("a", "ingest", "failed", error_class="OSError")]
    first = [attempt("a", "failed", error_class="OSError", seq=2)]
    assert folded("a", first, rows).videos["failed"] == 1
    again = folded("a", [*first, attempt("a", "scheduled", 2)], rows)
    assert again.videos["waiting"] == 1 and again.errors == () and again.records[0].attempt_number == 2
    done = folded("a", [*first, attempt("a", "done", 2, 3)], [*rows, *finished("a", 2)])
    assert done.videos["done"] == 1 and done.stages["ingest"] == {"done": 1}
    assert done.cost.wall_s == 8.0 and done.cost_by_stage["ingest"].cpu_s == 2.0, "what the failure cost is in the bill"


def test_an_orphan_that_finished_after_it_was_called_crashed_has_finished() -> None:
    rows = [attempt("a", "running", seq=1), attempt("a", "crashed", seq=2**30), attempt("a", "done", seq=2)]
    assert folded("a", rows).records[0].state == "done"
    assert folded("a", rows[:2]).records[0].state == "crashed"


def test_the_message_and_stage_of_a_failure_are_found_in_the_ledger_when_the_attempt_does_not_say() -> None:
    rows = [stage("a", "ingest"), stage("a", "perceive", "failed", seq=1, error_class="KeyError", error_message="k")]
    record = folded("a", [attempt("a", "failed")], rows).records[0]
    assert (record.error_class, record.error_message, record.stage) == ("KeyError", "k", "perceive")


@given(st.randoms(use_true_random=False))
def test_neither_the_order_of_the_rows_nor_their_times_matter(rng: random.Random) -> None:
    attempts, rows = [], []
    for video in "abcd":
        for number in range(1, rng.randint(1, 3) + 1):
            states = rng.sample(ATTEMPT_STATES, rng.randint(1, 4))
            attempts += [attempt(video, state, number, seq) for seq, state in enumerate(states)]
            rows += [stage(video, name, rng.choice(("done", "failed")), number, i) for i, name in enumerate(STAGES)]
    before = folded("abcd", attempts, rows)
    for row in (*attempts, *rows):
        clock = "at" if "at" in row else "started_at"
        row[clock] = datetime.fromtimestamp(rng.randint(0, 2**31), UTC)
    rng.shuffle(attempts)
    rng.shuffle(rows)
    assert folded("abcd", attempts, rows) == before
    assert sum(before.videos.values()) == 4 and set(before.videos) == set(VIDEO_STATES)
    assert all(sum(counts.values()) == 4 for counts in before.stages.values())


def test_a_cancelled_batch_cancels_what_was_not_started() -> None:
    status = folded("abc", [attempt("a", "running"), attempt("b", "done")], cancelled=True)
    assert (status.videos["running"], status.videos["done"], status.videos["cancelled"]) == (1, 1, 1)


def test_the_time_left_is_what_the_stages_that_are_left_took_shared_by_the_videos_side_by_side() -> None:
    done = finished("a", wall=3.0) + finished("b", wall=5.0)  # 4 s a stage in the mean
    ended = [attempt("a", "done"), attempt("b", "done")]
    assert folded("abcd", ended, done).eta_s == 2 * 3 * 4.0
    running = [*ended, attempt("c", "running", stage="coarse"), attempt("d", "running", stage="ingest")]
    with_cached = [*done, stage("c", "ingest", "cached", wall_s=0.0), stage("c", "perceive", "cached", wall_s=0.0)]
    assert folded("abcd", running, with_cached).eta_s == (1 * 4.0 + 3 * 4.0) / 2
    assert folded("ab", ended, done).eta_s == 0.0
    assert folded("abc", ended, [stage("a", "ingest")]).eta_s is None, "two stages were never measured"


def test_the_slowest_videos_and_the_bill_add_up() -> None:
    rows = [stage(video, "ingest", wall_s=float(i)) for i, video in enumerate("abcdefgh")]
    status = folded("abcdefgh", [], rows)
    assert list(status.slowest.items()) == [("h", 7.0), ("g", 6.0), ("f", 5.0), ("e", 4.0), ("d", 3.0)]
    assert status.cost.wall_s == 28.0 and status.cost.cpu_s == 8.0


def test_rows_of_videos_that_are_not_in_the_batch_are_left_out() -> None:
    status = folded("a", [attempt("z", "failed")], [stage("z", "ingest")])
    assert status.total == 1 and status.errors == () and status.cost.wall_s == 0


FAILURES = folded(
    "abcdef",
    [
        attempt("a", "failed", error_class="ValueError", stage="ingest"),
        attempt("b", "failed", error_class="OSError", stage="perceive"),
        attempt("c", "failed", error_class="OSError", stage="ingest"),
        attempt("d", "crashed", stage="coarse"),
        attempt("e", "done"),
        attempt("f", "cancelled"),
    ],
)


@pytest.mark.parametrize(
    ("how", "expected"),
    [
        ({}, "abcdf"),
        ({"states": ["failed"]}, "abc"),
        ({"stage": "ingest"}, "ac"),
        ({"error": "OSError"}, "bc"),
        ({"error": "OSError", "stage": "ingest"}, "c"),
        ({"error": "Crashed"}, "d"),
        ({"videos": ["e", "b"]}, "be"),
        ({"videos": ["e", "b"], "states": ["done"]}, "e"),
        ({"states": ["crashed", "cancelled"]}, "df"),
    ],
)
def test_a_rerun_selects_what_it_says_in_the_order_of_the_list(how: dict[str, Any], expected: str) -> None:
    assert "".join(select(FAILURES, **how)) == expected


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ({"videos": ["z"]}, "video 'z'"),
        ({"stage": "ingst"}, r"stage 'ingst'.*ingest"),
        ({"error": "TypeError"}, r"error 'TypeError'.*OSError"),
        ({"states": ["broken"]}, "state 'broken'"),
    ],
)
def test_a_selection_of_what_is_not_there_says_what_is(how: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        select(FAILURES, **how)


def test_the_json_is_plain_and_has_the_records_on_demand_only() -> None:
    plain = json.loads(json.dumps(FAILURES.to_json(), allow_nan=False))
    assert plain["videos"]["failed"] == 3 and "records" not in plain and plain["schema_version"] == 1
    assert [r["video_id"] for r in FAILURES.to_json(records=True)["records"]] == list("abcdef")


def test_the_status_of_a_stored_batch_is_the_fold_of_what_was_stored(store: ArtifactStore) -> None:
    tables = Tables(store)
    submit(store, manifest("a", "b"))
    assert batch_status(store, tables, "b").videos["waiting"] == 2
    tables.append("attempts", [attempt("a", "running"), attempt("a", "done", seq=1)], batch="b")
    tables.append("stages", finished("a"), batch="b")
    cancel_batch(store, "b")
    status = batch_status(store, tables, "b")
    assert (status.videos["done"], status.videos["cancelled"], status.cost.wall_s) == (1, 1, 6.0)
    assert list(status.stages) == list(STAGES)
