"""The one way to run a stage, on small stages that count how often they really run."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import pyarrow as pa
import pytest
from pydantic import BaseModel, ConfigDict

from flows.pipeline import Outcome, process
from storage_schema.artifacts import Blob
from storage_schema.store import ArtifactStore
from storage_schema.tables import Tables
from tasks.role import Role
from tasks.running import run_stage
from tasks.stage import Run, Source, Stage, StageContext, StageOutput, StageRef


class Knobs(BaseModel):
    model_config = ConfigDict(frozen=True)
    value: int = 1


class Toy(BaseModel):
    """Settings of the toy pipeline."""

    model_config = ConfigDict(frozen=True)
    first: Knobs = Knobs()
    second: Knobs = Knobs()
    third: Knobs = Knobs()


class Silent:
    def started(self, stage: str) -> None: ...
    def progress(self, stage: str, done: int, total: int, note: str) -> None: ...
    def finished(self, ref: StageRef, folder: Path) -> None: ...


class Pipeline:
    """source -> first -> second, and third straight from first."""

    def __init__(self, root: Path) -> None:
        self.made: list[str] = []
        self.root = root
        blobs = {name: (Blob("sum.json"),) for name in ("first", "second", "third")}
        self.store = ArtifactStore(root / "store", artifacts=blobs)
        self.tables = Tables(self.store)
        self.stages = (
            self._stage("first", ("source",)),
            self._stage("second", ("first",)),
            self._stage("third", ("first",)),
        )
        self.fail: dict[str, BaseException] = {}
        (root / "video").write_bytes(b"7")
        self.source = Source(root / "video", "hash-of-7")

    def _stage(self, name: str, needs: tuple[str, ...]) -> Stage:
        def run(config: Knobs, ctx: StageContext) -> StageOutput:
            (ctx.out / "half-written.tmp").write_text("x")
            if name in self.fail:
                raise self.fail[name]
            (ctx.out / "half-written.tmp").unlink()
            given = ctx.inputs[needs[0]]
            base = int(given.read_text()) if given.is_file() else json.loads((given / "sum.json").read_text())
            (ctx.out / "sum.json").write_text(json.dumps(base + config.value))
            self.made.append(name)
            return StageOutput(
                summary={"sum": base + config.value},
                metrics=[
                    dict.fromkeys(("config", "protocol", "protocol_id", "region", "camera"), "toy")
                    | {"frame": 0, "psnr": 30.0}
                ],
            )

        return Stage(name, 1, Knobs, needs, run)

    def go(self, settings: Toy | None = None, only: tuple[str, ...] | None = None) -> Outcome:
        run = Run(self.store, self.tables, "b", "v", "r", Silent())
        return process(self.source, settings or Toy(), run, only=only, stages=self.stages)  # type: ignore[arg-type]

    def ledger(self) -> list[dict]:
        return self.tables.read("stages").to_pylist()


@pytest.fixture
def pipeline(tmp_path: Path) -> Pipeline:
    return Pipeline(tmp_path)


def test_a_second_run_makes_nothing_again(pipeline: Pipeline) -> None:
    first = pipeline.go()
    second = pipeline.go()
    assert pipeline.made == ["first", "second", "third"]
    assert {r.state for r in first.refs.values()} == {"done"} and {r.state for r in second.refs.values()} == {"cached"}
    assert {n: r.content_hash for n, r in first.refs.items()} == {n: r.content_hash for n, r in second.refs.items()}


def test_a_changed_knob_reruns_its_stage_and_what_depends_on_it_alone(pipeline: Pipeline) -> None:
    pipeline.go()
    pipeline.go(Toy(second=Knobs(value=5)))
    assert pipeline.made == ["first", "second", "third", "second"]
    pipeline.go(Toy(first=Knobs(value=5)))
    assert pipeline.made[4:] == ["first", "second", "third"]


def test_an_unchanged_output_stops_the_rerun(pipeline: Pipeline) -> None:
    """Keys follow contents: first gives 8 from 7 + 1 however it is reached, so its readers need not run again."""
    pipeline.go()
    pipeline.source = Source(pipeline.source.path, "another-hash-of-the-same-number")
    pipeline.go()
    assert pipeline.made == ["first", "second", "third", "first"]


@pytest.mark.parametrize("damage", [lambda p: p.unlink(), lambda p: p.write_bytes(b""), lambda p: p.write_text("8")])
def test_a_damaged_output_is_made_again(pipeline: Pipeline, damage: Callable[[Path], object]) -> None:
    ref = pipeline.go().refs["second"]
    manifest = pipeline.store.lookup(ref.key)
    assert manifest is not None
    damage(pipeline.store.fetch(manifest, "sum.json"))
    pipeline.go()
    assert pipeline.made == ["first", "second", "third", "second"]


@pytest.mark.parametrize("error", [RuntimeError("no luck"), KeyboardInterrupt()])
def test_a_failure_is_in_the_ledger_and_leaves_nothing_half_made(pipeline: Pipeline, error: BaseException) -> None:
    pipeline.fail["second"] = error
    with pytest.raises(type(error)):
        pipeline.go()
    row = next(r for r in pipeline.ledger() if r["state"] == "failed")
    assert (row["stage"], row["error_class"]) == ("second", type(error).__name__)
    assert not list((pipeline.root / "store").rglob("half-written*"))
    pipeline.fail.clear()
    pipeline.go()
    assert pipeline.made == ["first", "second", "third"], "the finished stage was made again"


def test_stages_not_asked_for_are_skipped_with_the_reason(pipeline: Pipeline) -> None:
    outcome = pipeline.go(only=("second",))
    assert pipeline.made == ["first", "second"] and "not asked for" in outcome.skipped["third"]
    row = next(r for r in pipeline.ledger() if r["state"] == "skipped")
    assert row["stage"] == "third" and "not asked for" in row["reason"]


def test_an_unknown_stage_is_refused_with_the_known_ones(pipeline: Pipeline) -> None:
    with pytest.raises(ValueError, match="first, second, third, got fourth"):
        pipeline.go(only=("fourth",))


def test_the_ledger_holds_time_knobs_and_scores(pipeline: Pipeline) -> None:
    pipeline.go()
    rows = {r["stage"]: r for r in pipeline.ledger()}
    assert json.loads(rows["first"]["knobs"]) == {"value": 1} and rows["first"]["wall_s"] > 0
    metrics: pa.Table = pipeline.tables.read("metrics")
    assert metrics.num_rows == 3 and set(metrics.column("psnr").to_pylist()) == {30.0}


def test_a_reference_survives_json(pipeline: Pipeline) -> None:
    ref = pipeline.go().refs["first"]
    assert StageRef.from_json(json.loads(json.dumps(ref.to_json()))) == ref


def test_a_missing_input_is_named(pipeline: Pipeline) -> None:
    run = Run(pipeline.store, pipeline.tables, "b", "v", "r", Silent())
    with pytest.raises(ValueError, match="run those stages first"):
        run_stage(pipeline.stages[1], Knobs(), {}, run)


def test_a_metric_row_says_who_filled_the_roles_of_its_stage_and_of_those_before(tmp_path: Path) -> None:
    pipeline = Pipeline(tmp_path)
    named = {"first": {"pose": Role("NLF", "MIT")}, "second": {"perceptual": Role("LPIPS", "BSD")}}
    pipeline.stages = tuple(
        dataclasses.replace(stage, roles=lambda config, name=stage.name: named.get(name, {}))
        for stage in pipeline.stages
    )
    run = Run(pipeline.store, pipeline.tables, "b", "v", "r", Silent())
    process(pipeline.source, Toy(), run, stages=pipeline.stages)  # type: ignore[arg-type]
    rows = [json.loads(row["roles"]) for row in pipeline.tables.read("metrics", "b").to_pylist()]
    assert rows == [{"pose": "NLF"}, {"pose": "NLF", "perceptual": "LPIPS"}, {"pose": "NLF"}]
