"""Stages that are made once for each item, that may be absent, and that explain what was left out."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from pydantic import BaseModel, ConfigDict

from flows.pipeline import Outcome, process
from storage_schema.artifacts import Blob
from storage_schema.store import ArtifactStore
from storage_schema.tables import Tables
from tasks.stage import Run, Source, Stage, StageContext, StageOutput, StageRef

NAMES = ("plan", "paint", "gather", "tell")


class Knobs(BaseModel):
    model_config = ConfigDict(frozen=True)


class Toy(BaseModel):
    model_config = ConfigDict(frozen=True)
    plan: Knobs = Knobs()
    paint: Knobs = Knobs()
    gather: Knobs = Knobs()
    tell: Knobs = Knobs()


class Listener:
    def __init__(self) -> None:
        self.heard: list[str] = []

    def started(self, stage: str) -> None:
        self.heard.append(stage)

    def progress(self, stage: str, done: int, total: int, note: str) -> None: ...
    def showed(self, stage: str, picture: Path) -> None: ...
    def finished(self, ref: StageRef, folder: Path) -> None:
        assert ref.title == self.heard[-1]


class Pipeline:
    """plan -> paint, once for each planned item -> gather, which takes what there is -> tell, which explains."""

    def __init__(self, root: Path) -> None:
        blobs = {name: (Blob("out.json"),) for name in NAMES}
        self.root, self.store, self.made = root, ArtifactStore(root / "store", artifacts=blobs), list[str]()
        self.fails: set[str] = set()
        self.reason, self.items = "", ["a", "b", "c"]
        self.listener = Listener()
        (root / "video").write_bytes(b"v")

    def stages(self) -> tuple[Stage, ...]:
        def write(content: Any) -> Any:
            def run(config: Knobs, ctx: StageContext) -> StageOutput:
                if ctx.item in self.fails:
                    raise RuntimeError(f"no luck with {ctx.item}")
                self.made.append(ctx.item or "-")
                value = content(ctx)
                (ctx.out / "out.json").write_text(json.dumps(value))
                return StageOutput({"items": self.items, "told": value})

            return run

        def obstacle(run: Run, summaries: Mapping[str, Mapping[str, Any]]) -> str:
            assert set(summaries["plan"]["items"]) == set(self.items)
            return self.reason

        return (
            Stage("plan", 1, Knobs, ("source",), write(lambda ctx: self.items)),
            Stage("paint", 1, Knobs, ("plan",), write(lambda ctx: ctx.item), over="plan", obstacle=obstacle),
            Stage("gather", 1, Knobs, ("plan",), write(lambda ctx: sorted(ctx.inputs)), wants=("paint",)),
            Stage("tell", 1, Knobs, ("gather",), write(lambda ctx: dict(ctx.skipped)), explains=True),
        )

    def go(self) -> Outcome:
        run = Run(self.store, Tables(self.store), "b", "v", "r", self.listener)
        source = Source(self.root / "video", "hash")
        return process(source, Toy(), run, stages=self.stages())  # type: ignore[arg-type]

    def told(self, outcome: Outcome, title: str) -> Any:
        ref = outcome.refs[title]
        manifest = self.store.lookup(ref.key, stage=ref.stage)
        assert manifest is not None
        return manifest.summary["told"]


@pytest.fixture
def pipeline(tmp_path: Path) -> Pipeline:
    return Pipeline(tmp_path)


def test_each_item_has_a_key_and_an_artifact_and_its_reader_gets_them_all(pipeline: Pipeline) -> None:
    outcome = pipeline.go()
    painted = [title for title in outcome.refs if title.startswith("paint/")]
    assert painted == ["paint/a", "paint/b", "paint/c"]
    assert len({outcome.refs[title].key for title in painted}) == 3
    assert [pipeline.told(outcome, title) for title in painted] == ["a", "b", "c"]
    assert pipeline.told(outcome, "gather") == ["paint/a", "paint/b", "paint/c", "plan"]
    assert pipeline.listener.heard == ["plan", *painted, "gather", "tell"]


def test_a_failure_at_the_third_item_does_not_repeat_the_first_two(pipeline: Pipeline) -> None:
    pipeline.fails = {"c"}
    with pytest.raises(RuntimeError, match="with c"):
        pipeline.go()
    pipeline.fails = set()
    assert {ref.state for title, ref in pipeline.go().refs.items() if title in ("paint/a", "paint/b")} == {"cached"}
    assert pipeline.made == ["-", "a", "b", "c", "-", "-"]
    rows = Tables(pipeline.store).read("stages").to_pylist()
    failed = next(row for row in rows if row["state"] == "failed")
    assert failed["stage"] == "paint" and json.loads(failed["knobs"])["item"] == "c"


def test_an_obstacle_skips_a_stage_and_its_reader_does_without(pipeline: Pipeline) -> None:
    pipeline.reason = "somebody else was closer"
    outcome = pipeline.go()
    assert outcome.skipped == {"paint": "somebody else was closer"}
    assert pipeline.told(outcome, "gather") == ["plan"]
    assert pipeline.told(outcome, "tell") == {"paint": "somebody else was closer"}


def test_what_needs_a_skipped_stage_is_skipped_too(pipeline: Pipeline) -> None:
    pipeline.reason = "no"
    plan, paint, gather, tell = pipeline.stages()
    stages = (plan, paint, replace(gather, needs=("plan", "paint"), wants=()), replace(tell, needs=("plan",)))
    run = Run(pipeline.store, Tables(pipeline.store), "b", "v", "r", pipeline.listener)
    outcome = process(Source(pipeline.root / "video", "hash"), Toy(), run, stages=stages)  # type: ignore[arg-type]
    assert outcome.skipped["gather"] == "needs paint, which was skipped"
    assert set(pipeline.told(outcome, "tell")) == {"paint", "gather"}


def test_an_explanation_is_part_of_the_key_of_who_explains_alone(pipeline: Pipeline) -> None:
    pipeline.reason = "one reason"
    first = pipeline.go()
    pipeline.reason = "another reason"
    second = pipeline.go()
    assert first.refs["gather"].key == second.refs["gather"].key
    assert first.refs["tell"].key != second.refs["tell"].key


def test_no_items_make_no_artifacts(pipeline: Pipeline) -> None:
    pipeline.items = []
    outcome = pipeline.go()
    assert pipeline.told(outcome, "gather") == ["plan"] and not outcome.skipped
