"""A plan made from a real batch's ledger says what that batch took: real processes, the real store, real stages."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pyarrow as pa
import pytest
from typer.testing import CliRunner

from ahoy_core.cost.plan import plan
from ahoy_core.cost.simulate import Fleet, MeasuredAttempt, MeasuredVideo
from flows.cli import app
from storage_schema.batches import BatchEntry, BatchManifest, submit
from storage_schema.schemas import TABLES
from storage_schema.status import batch_status
from storage_schema.store import ArtifactStore
from storage_schema.tables import Tables
from tasks.ledger import measured, read_measured

VIDEOS, WORKERS, FLAKY = 18, 3, 6
WORKER = """
import itertools, json, random, sys, time
from datetime import UTC, datetime
from pathlib import Path
from pydantic import BaseModel
from storage_schema.artifacts import Blob
from storage_schema.batches import read_batch
from storage_schema.store import ArtifactStore
from storage_schema.tables import Tables
from tasks.running import run_stage
from tasks.stage import Run, Source, Stage, StageOutput

root, me, workers, flaky = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4])

class Knobs(BaseModel):
    seconds: float
    fail: bool = False

def sleep(config, ctx):
    time.sleep(config.seconds)
    if config.fail:
        raise ConnectionError("the line dropped")
    (ctx.out / "x.json").write_text("{}")
    return StageOutput()

class Silent:
    def started(self, stage): ...
    def progress(self, stage, done, total, note): ...
    def finished(self, ref, folder): ...

STAGES = [Stage("fetch", 1, Knobs, ("source",), sleep), Stage("fit", 1, Knobs, ("fetch",), sleep)]
store = ArtifactStore(root / "store", workers=workers, artifacts={s.name: (Blob("x.json"),) for s in STAGES})
tables = Tables(store)

def attempt(video, number):
    rng, started = random.Random(video), time.monotonic()
    seconds = {"fetch": rng.uniform(0.02, 0.1), "fit": rng.uniform(0.05, 0.3)}
    run = Run(store, tables, "b", video, f"{video}-{number}", Silent(), attempt_number=number)
    row = {"video_id": video, "run_id": run.run_id, "attempt_number": number}
    def tell(seq, state):
        wall = time.monotonic() - started
        now = datetime.now(UTC)
        tables.append("attempts", [{**row, "seq": seq, "state": state, "at": now, "wall_s": wall}], batch="b")
    tell(0, "running")
    ref = Source(root, "hash-of-" + video)
    try:
        for stage in STAGES:
            fail = stage.name == "fit" and number == 1 and int(video[1:]) % flaky == 0
            ref = run_stage(stage, Knobs(seconds=seconds[stage.name], fail=fail), {stage.needs[0]: ref}, run)
    except ConnectionError:
        tell(1, "failed")
        return False
    tell(1, "done")
    return True

entries = read_batch(store, "b").entries
(root / f"ready-{me}").touch()
while not all((root / f"ready-{other}").exists() for other in range(workers)):
    time.sleep(0.005)
for entry in entries:
    try:
        (root / f"claim-{entry.video_id}").open("x").close()
    except FileExistsError:
        continue
    attempt(entry.video_id, 1) or attempt(entry.video_id, 2)
"""


@pytest.fixture(scope="module")
def batch(tmp_path_factory: pytest.TempPathFactory) -> ArtifactStore:
    root = tmp_path_factory.mktemp("batch")
    store = ArtifactStore(root / "store", workers=WORKERS)
    submit(store, BatchManifest.of("b", [BatchEntry(f"v{i}", f"v{i}.mp4") for i in range(VIDEOS)]))
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2]), "OMP_NUM_THREADS": "1"}
    arguments = [str(root), str(WORKERS), str(FLAKY)]
    running = [
        subprocess.Popen([sys.executable, "-c", WORKER, arguments[0], str(me), *arguments[1:]], env=environment)
        for me in range(WORKERS)
    ]
    assert [process.wait() for process in running] == [0] * WORKERS
    return store


def test_the_batch_ran_as_it_was_meant_to(batch: ArtifactStore) -> None:
    status = batch_status(batch, Tables(batch), "b")
    assert status.videos["done"] == VIDEOS and status.errors == ()
    assert sorted(r.attempt_number for r in status.records).count(2) == VIDEOS // FLAKY
    assert status.eta_s == 0.0 and status.cost.wall_s > 0


def test_the_plan_of_a_real_batch_is_what_it_took(batch: ArtifactStore) -> None:
    rows = Tables(batch).read("attempts", "b")
    # One machine, one clock: from the first start to the last end, in the batch's own seconds.
    actual = (max(rows["at"].to_pylist()) - min(rows["at"].to_pylist())).total_seconds()
    made = plan(read_measured(batch), Fleet(WORKERS), VIDEOS)
    # 18 videos whose times vary by 40%: one draw of them varies by 10%, and so does the end, where workers run out of
    # videos one by one. Three times both is 0.42.
    assert 0.7 < made.makespan_s.median / actual < 1.42
    assert made.attempts / VIDEOS == pytest.approx(1 + 1 / FLAKY, abs=0.05)
    alone = plan(read_measured(batch), Fleet(1), VIDEOS)
    walls = sum(row["wall_s"] for row in rows.to_pylist() if row["state"] != "running")
    assert alone.makespan_s.median == pytest.approx(walls, rel=0.15), "one worker takes the sum"


def test_the_command_says_the_same(batch: ArtifactStore) -> None:
    ask = ["plan", "--store", batch.url, "--videos", "40", "--workers", "4", "--slot", "gpu=1:fit", "--price", "2"]
    answer = CliRunner().invoke(app, [*ask, "--json"])
    assert answer.exit_code == 0, answer.output
    plain = json.loads(answer.output)
    uses = plain["uses"]
    assert plain["measured_videos"] == VIDEOS and set(uses) == {"worker", "gpu"}
    assert plain["bottleneck"] == max(uses, key=lambda name: uses[name]["utilisation"])
    shown = CliRunner().invoke(app, ask)
    assert "bottleneck" in shown.output and "40 videos on 4 workers (4 machines)" in shown.output


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--slot", "gpu=1"], "expected NAME=COUNT:STAGE"),
        (["--slot", "gpu=1:coarse"], "never measured; the ledger has"),
        (["--slot", "gpu=1:fit", "--slot", "cpu=1:fit"], "a stage holds one"),
        (["--slot", "gpu=0:fit"], "at least one worker"),
        (["--batch", "none"], "run a small batch first"),
    ],
)
def test_what_cannot_be_planned_is_a_line_and_an_exit_status(
    batch: ArtifactStore, more: list[str], message: str
) -> None:
    answer = CliRunner().invoke(app, ["plan", "--store", batch.url, "--videos", "4", *more])
    assert answer.exit_code == 2 and answer.output.startswith("error:")
    assert message in " ".join(answer.output.split())


def stage(video: str, name: str, wall: float, state: str = "done", number: int = 1, seq: int = 0) -> dict[str, object]:
    row = {"batch": "b", "video_id": video, "stage": name, "wall_s": wall, "state": state}
    return {**row, "attempt_number": number, "seq": seq}


def end(video: str, state: str, wall: float | None, number: int = 1) -> dict[str, object]:
    return {"batch": "b", "video_id": video, "state": state, "wall_s": wall, "attempt_number": number}


def folded(stages: list[dict[str, object]], attempts: list[dict[str, object]]) -> list[MeasuredVideo]:
    batch = pa.field("batch", pa.string())
    tables = [
        pa.Table.from_pylist(rows, schema=pa.schema([batch, *TABLES[name].columns]))
        for name, rows in (("stages", stages), ("attempts", attempts))
    ]
    return measured(*tables)


def test_rows_become_attempts_with_their_overhead_and_cached_stages_take_no_time() -> None:
    rows = [stage("a", "fit", 2.0, "failed", seq=1), stage("a", "fetch", 1.0)]
    rows += [stage("a", "fetch", 0.0, "cached", 2), stage("a", "fit", 3.0, "done", 2, 1)]
    ends = [end("a", "running", 0.0), end("a", "failed", 3.5), end("a", "done", 3.25, 2)]
    first = MeasuredAttempt((("fetch", 1.0), ("fit", 2.0)), 0.5, False)
    assert folded(rows, ends) == [MeasuredVideo((first, MeasuredAttempt((("fit", 3.0),), 0.25, True)))]


def test_videos_that_are_not_over_or_were_only_looked_up_are_left_out() -> None:
    rows = [stage("a", "fetch", 1.0), stage("b", "fetch", 0.0, "cached"), stage("c", "fetch", 4.0)]
    ends = [end("a", "running", None), end("b", "done", 1.0)]
    assert folded(rows, ends) == [MeasuredVideo((MeasuredAttempt((("fetch", 4.0),)),))], "c: a single `ahoy run`"
