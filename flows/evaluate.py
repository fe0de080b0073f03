"""The evaluation (paper section 4): captures x configurations, every cell found in the store or made.

A cell is one configuration on one capture: the stages up to the avatar, then the stage `evaluate`. The store knows
what is done, so a second run makes nothing again and one that was interrupted goes on where it stopped. One cell that
fails is reported and does not stop the others.
"""

from __future__ import annotations

import re
import uuid
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

from prefect import flow, task
from prefect.cache_policies import NO_CACHE

from ahoy_core.avatar.full_config import ABLATIONS
from ahoy_core.captures import Capture
from ahoy_core.metrics.score import REFERENCES
from flows.evaluate_request import EvaluateRequest, OtherSystem
from flows.pipeline import Outcome, call_directly, process
from storage_schema.store import ArtifactStore
from storage_schema.tables import Tables
from tasks.evaluation.baseline_inputs import export_inputs
from tasks.evaluation.baselines import BASELINES, mesh_renderer
from tasks.evaluation.cell import MakeRenderer, avatar_renderer, evaluate_stage, reference_renderer
from tasks.evaluation.config import EvaluateConfig
from tasks.evaluation.fitted import Fitted
from tasks.evaluation.folders import folder_renderer, renders_source
from tasks.evaluation.inputs import known_camera, truth_source, video_source
from tasks.evaluation.results import Cell, read_metrics, write_results
from tasks.evaluation.truths import Truths
from tasks.evaluation.withhold import WITHHOLD, WithholdConfig
from tasks.fills import fills_from_environment
from tasks.presets import PRESETS
from tasks.running import run_stage
from tasks.settings import Settings
from tasks.stage import Observer, Run, Source, Stage, StageRef

BATCH = "evaluate"
_UNSAFE = re.compile(r"[^A-Za-z0-9._-]+")


@dataclass(frozen=True)
class Subject:
    """A capture with what all its cells share."""

    request: EvaluateRequest
    capture: Capture
    store: ArtifactStore
    observer: Observer

    @cached_property
    def truth(self) -> Source:
        """The capture by content."""
        return truth_source(self.capture)

    @cached_property
    def video(self) -> Source:
        """The input."""
        return video_source(self.capture, self.truth.content_hash, Path(self.request.out) / "inputs")

    @property
    def every(self) -> int | None:
        """How many frames apart those are that are withheld; only where there is no other truth."""
        return None if self.capture.views else self.request.withhold

    def settings(self, config: str) -> Settings:
        """The preset under the switches of a configuration, told the camera if the method may know it."""
        chosen = PRESETS[self.request.preset].with_overrides(self.request.overrides)
        avatar = chosen.avatar.model_copy(update={"switches": ABLATIONS[config]})
        camera = known_camera(self.capture) if self.request.give_camera else None
        perceive = chosen.perceive.model_copy(update={"camera": camera})
        return chosen.model_copy(update={"avatar": avatar, "perceive": perceive})

    def run(self) -> Run:
        """An attempt at a cell of this capture."""
        name = _UNSAFE.sub("-", self.capture.name).lstrip(".-_") or "capture"
        chosen = PRESETS[self.request.preset].with_overrides(self.request.overrides)
        fills = fills_from_environment()
        return Run(
            self.store,
            Tables(self.store),
            BATCH,
            name,
            uuid.uuid4().hex[:12],
            self.observer,
            fills.body(chosen.body),
            prior=chosen.prior,
            fills=fills,
        )

    def config(self, name: str, **more: Any) -> EvaluateConfig:
        """What the stage `evaluate` is told for a cell."""
        camera = self.request.give_camera and known_camera(self.capture) is not None
        request = self.request
        return EvaluateConfig(
            capture=self.capture.name,
            config=name,
            protocols=request.protocols,
            size=request.size,
            input="video and camera" if camera else "video",
            **more,
        )


def stages_up_to(subject: Subject, config: str, last: str, run: Run) -> tuple[Outcome, StageRef]:
    """Run the stages that a cell needs; perception as it was found, before frames were withheld, comes beside."""
    found: dict[str, StageRef] = {}

    def call(stage: Stage, settings: Settings, inputs: Mapping[str, StageRef | Source], run: Run) -> StageRef:
        ref = call_directly(stage, settings, inputs, run)
        if stage.name != "perceive":
            return ref
        found["perceive"] = ref
        if subject.every is None:
            return ref
        return run_stage(WITHHOLD, WithholdConfig(every=subject.every), {"perceive": ref}, run)

    outcome = process(subject.video, subject.settings(config), run, only=(last,), call=call)
    return outcome, found["perceive"]


def score(
    subject: Subject, name: str, outcome: Outcome, perceived: StageRef, needs: tuple[str, ...], make: MakeRenderer
) -> StageRef:
    """Run the stage `evaluate` on finished stages."""
    stage = evaluate_stage(subject.capture, subject.every, needs, make)
    inputs: dict[str, StageRef | Source] = {
        "capture": subject.truth,
        "ingest": outcome.refs["ingest"],
        "perceive": perceived,
        **{need: outcome.refs[need] for need in needs},
    }
    return run_stage(stage, subject.config(name), inputs, subject.run())


def avatar_cell(subject: Subject, config: str) -> Cell:
    """One configuration on one capture."""
    outcome, perceived = stages_up_to(subject, config, "avatar", subject.run())
    ref = score(subject, config, outcome, perceived, ("avatar",), avatar_renderer)
    return Cell(subject.capture.name, config, ref, facts=_facts(subject.store, outcome))


def reference_cell(subject: Subject, name: str) -> Cell:
    """A reference row on one capture."""
    outcome, perceived = stages_up_to(subject, "full", "perceive", subject.run())
    ref = score(subject, name, outcome, perceived, (), reference_renderer(name))
    return Cell(subject.capture.name, name, ref)


def baseline_cell(subject: Subject, name: str) -> Cell:
    """A built-in baseline on one capture."""
    chosen = subject.request.model_copy(update={"overrides": (*subject.request.overrides, *BASELINES[name])})
    mine = replace(subject, request=chosen)
    outcome, perceived = stages_up_to(mine, "full", "texture", mine.run())
    ref = score(mine, name, outcome, perceived, ("texture",), partial(mesh_renderer, name))
    return Cell(subject.capture.name, name, ref)


def export_inputs_of(subject: Subject, folder: Path) -> None:
    """Write what other systems are given of one capture."""
    outcome, perceived = stages_up_to(subject, "full", "complete", subject.run())
    last = outcome.refs.get("complete", outcome.refs["texture"])
    manifests = [
        subject.store.lookup(ref.key, stage=ref.stage, verify=False)
        for ref in (outcome.refs["ingest"], perceived, last)
    ]
    ingest, perceive, texture = (subject.store.fetch(manifest) for manifest in manifests if manifest)
    export_inputs(ingest, perceive, texture, folder / subject.capture.name)


def other_cell(subject: Subject, name: str) -> Cell:
    """Another system's renders of one capture."""
    other = next(one for text in subject.request.renders if (one := OtherSystem.of(text)).name == name)
    outcome, perceived = stages_up_to(subject, "full", "perceive", subject.run())
    stage = evaluate_stage(subject.capture, subject.every, ("renders",), folder_renderer)
    inputs: dict[str, StageRef | Source] = {
        "capture": subject.truth,
        "ingest": outcome.refs["ingest"],
        "perceive": perceived,
        "renders": renders_source(other.folder, subject.capture.name),
    }
    config = subject.config(name, input_setting=other.input_setting)
    return Cell(subject.capture.name, name, run_stage(stage, config, inputs, subject.run()))


def _facts(store: ArtifactStore, outcome: Outcome) -> dict[str, Any]:
    manifests = [store.lookup(ref.key, stage=ref.stage, verify=False) for ref in outcome.refs.values()]
    roles = {role for manifest in manifests if manifest for role in manifest.roles}
    avatar = next(manifest for manifest in manifests if manifest and manifest.stage == "avatar")
    return {"avatar": avatar.blob("avatar.safetensors").sha256, "prior": "video" in roles}


MakeCell = Callable[[Subject, str], Cell]
Watch = Callable[[MakeCell, Subject, str], Cell]
"""How a cell is made: directly, or as a Prefect task."""


def directly(make: MakeCell, subject: Subject, name: str) -> Cell:
    """Make a cell in this process."""
    return make(subject, name)


def as_task(make: MakeCell, subject: Subject, name: str) -> Cell:
    """Make a cell as a Prefect task of its own."""
    run_name = f"{subject.capture.name} {name}"
    watched = task(name="cell", task_run_name=run_name, cache_policy=NO_CACHE, persist_result=False)(
        lambda: make(subject, name)
    )
    cell: Cell = watched()
    return cell


def evaluate(
    request: EvaluateRequest, observer: Observer, watch: Watch = directly, told: Callable[[str], None] = lambda _: None
) -> tuple[dict[str, Path], list[Cell]]:
    """Score every capture under every configuration.

    Args:
        request: what.
        observer: who watches the stages.
        watch: how a cell is made.
        told: called with a line about each finished cell.

    Returns:
        Paths of what was written, and the cells: those that failed say why.

    Raises:
        ValueError: nothing could be scored, or the data set is not one.
    """
    store = request.open_store()
    subjects = [Subject(request, capture, store, observer) for capture in request.captures()]
    cells: list[Cell] = []
    for subject in subjects:
        if request.export_inputs:
            export_inputs_of(subject, Path(request.export_inputs))
            told(f"{subject.capture.name}: inputs of other systems are in {request.export_inputs}")
        jobs: list[tuple[str, MakeCell]] = [(name, avatar_cell) for name in request.ablate]
        jobs += [(name, baseline_cell) for name in request.baselines]
        jobs += [(OtherSystem.of(text).name, other_cell) for text in request.renders]
        jobs += [(name, reference_cell) for name in REFERENCES]
        for name, make in jobs:
            cells.append(_guarded(make, subject, name, watch))
            told(f"{subject.capture.name}, {name}: {cells[-1].error or cells[-1].ref.state}")  # type: ignore[union-attr]
    if not any(cell.ref for cell in cells):
        raise ValueError(f"nothing could be scored; the first reason: {cells[0].error if cells else 'no cells'}")
    truths = {subject.capture.name: _truths(subject) for subject in subjects}
    others = [row for path in request.beside for row in read_metrics(Path(path))]
    return write_results(store, cells, truths, Path(request.out), _heading(request, subjects), others), cells


def _guarded(make: MakeCell, subject: Subject, name: str, watch: Watch) -> Cell:
    try:
        return watch(make, subject, name)
    except Exception as error:  # a cell that fails is a finding about that cell
        return Cell(subject.capture.name, name, error=f"{type(error).__name__}: {error}")


def _truths(subject: Subject) -> Truths:
    """The truths again, for the pictures; perception is found in the store."""
    try:
        outcome, perceived = stages_up_to(subject, "full", "perceive", subject.run())
    except Exception:  # it failed before, as every cell of this capture did
        return Truths(subject.capture, None, subject.request.size, subject.every)
    folders = []
    for ref in (outcome.refs["ingest"], perceived):
        manifest = subject.store.lookup(ref.key, stage=ref.stage, verify=False)
        assert manifest is not None
        folders.append(subject.store.fetch(manifest))
    return Truths(subject.capture, Fitted.read(*folders), subject.request.size, subject.every)


def _heading(request: EvaluateRequest, subjects: Sequence[Subject]) -> list[str]:
    knobs = "".join(f" --set {knob}" for knob in request.overrides)
    command = (
        f"ahoy evaluate {Path(request.dataset).name} --preset {request.preset} --ablate {','.join(request.ablate)}"
    )
    names = ", ".join(subject.capture.name for subject in subjects)
    return [
        f"# Scores of {Path(request.dataset).name}",
        f"    {command}{knobs} --size {request.size}",
        f"{len(subjects)} captures: {names}. Means over captures of means over pictures; docs/metrics.md says what "
        "each protocol and region is. The last two rows of each table are references, not methods.",
    ]


@flow(name="evaluate", persist_result=False)
def evaluate_flow(request: EvaluateRequest) -> dict[str, str]:
    """The evaluation as a Prefect flow, a task a cell."""
    from flows.prefect_observer import PrefectObserver

    paths, _ = evaluate(request, PrefectObserver(), as_task)
    return {name: str(path) for name, path in paths.items()}
