"""The sweeps of `ahoy cost`: every stage on inputs out of the store, and whole runs from the video to the report.

A row that was measured is not measured again: it is found by the hash of all it depends on. What fails is a row too,
and one of the omissions.
"""

from __future__ import annotations

import hashlib
import json
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from ahoy_core.avatar.files import load_avatar
from ahoy_core.captures import Capture
from ahoy_core.cost.sweep import Measurement, Spread, sweep
from ahoy_core.cost.work import KNOBS
from flows.evaluate import Subject, stages_up_to
from flows.evaluate_request import EvaluateRequest
from flows.pipeline import call_directly, process
from storage_schema.store import ArtifactStore
from tasks.cost.change import Change
from tasks.cost.declared import StageSweep
from tasks.cost.errors import whole_errors
from tasks.cost.predict import ingested, work_knobs
from tasks.cost.rows import Rows
from tasks.cost.truth import truth_stage
from tasks.prior_folder import no_prior, prior_role
from tasks.running import resolve_inputs, run_stage
from tasks.settings import Settings
from tasks.stage import NoKnobs, Observer, Run, Source, Stage, StageContext, StageRef
from tasks.stages import STAGES

Told = Callable[[str], None]
END = STAGES[-1].name


@dataclass(frozen=True)
class Base:
    """A capture with the settings that knobs are changed around.

    Attributes:
        request: the evaluation that a whole run is scored by; its preset and overrides are the base settings.
        capture: of its data set.
        store: where inputs and whole runs are kept.
        observer: who watches the stages.
    """

    request: EvaluateRequest
    capture: Capture
    store: ArtifactStore
    observer: Observer

    @property
    def subject(self) -> Subject:
        """As the evaluation sees it."""
        return Subject(self.request, self.capture, self.store, self.observer)


def stage_rows(
    base: Base, declared: StageSweep, values: Mapping[str, Sequence[Any]], repeats: int, rows: Rows, told: Told
) -> None:
    """Sweep the knobs of one stage on one capture, and keep each row as it is measured.

    Args:
        base: capture and base settings.
        declared: how the stage is swept.
        values: knob -> values.
        repeats: runs of every setting.
        rows: where they are kept; those that are there are not measured again.
        told: called with a line on each knob.
    """
    with tempfile.TemporaryDirectory() as scratch:
        bench = _Bench(base, declared, Path(scratch))
        for knob, choices in values.items():
            name = f"{declared.stage.name}.{knob}"
            hashes = {bench.made_of({knob: value}): {knob: value} for value in choices}
            left = {key: setting for key, setting in hashes.items() if not rows.reuse(key, name, setting, repeats)}
            told(f"{base.capture.name}, {name}: {len(left)} of {len(hashes)} to measure")
            if left:
                bench.warm()
            found = sweep(name, left.values(), bench.make, bench.errors, repeats=repeats, warm=False)
            for made_of, row in zip(left, found, strict=True):
                knobs = bench.knobs(row.setting)
                rows.add(replace(row, capture=base.capture.name, knobs=knobs, made_of=made_of))


class _Bench:
    """One stage on one capture's inputs, to be run at any setting.

    Args:
        base: capture and base settings.
        declared: how the stage is swept.
        scratch: where outputs go.
    """

    def __init__(self, base: Base, declared: StageSweep, scratch: Path) -> None:
        self._capture, self._declared, self._scratch = base.capture, declared, scratch
        self._settings, self._run = base.subject.settings("full"), base.subject.run()
        self._config: BaseModel = getattr(self._settings, declared.stage.name)
        refs = _inputs(base, declared, self._run)
        self._hashes = {name: ref.content_hash for name, ref in refs.items()}
        self._manifests, self._folders = resolve_inputs(declared.stage, refs, base.store)
        self._numbers, self._warm = count(), False

    def make(self, setting: Mapping[str, Any]) -> Path:
        """Run the stage; returns the folder of its output."""
        chosen = {**self._config.model_dump(), **self._declared.knows(self._capture), **setting}
        config = type(self._config).model_validate(chosen)
        out, run = self._scratch / str(next(self._numbers)), self._run
        out.mkdir()
        ctx = StageContext(self._folders, self._manifests, out, _untold, run.body, prior=run.prior, fills=run.fills)
        self._declared.forget(config, ctx)
        self._declared.stage.run(config, ctx)
        return out

    def warm(self) -> None:
        """Run the stage once at its cheapest, unless that was done: compilation and caches are not what is measured."""
        if not self._warm:
            self.make(self._declared.warm_up)
            self._warm = True

    def errors(self, made: Path) -> Mapping[str, float]:
        """Errors of an output folder."""
        return self._declared.errors(self._capture, self._folders, made)

    def made_of(self, setting: Mapping[str, Any]) -> str:
        """Hash of all that a row depends on."""
        known = {name: str(value) for name, value in self._declared.knows(self._capture).items()}
        knobs = {**self._config.model_dump(mode="json"), **known, **setting}
        stage = self._declared.stage
        return _hash([stage.name, stage.version, knobs, self._hashes])

    def knobs(self, setting: Mapping[str, Any]) -> dict[str, Any]:
        """What decides the work at a setting."""
        changed = {f"{self._declared.stage.name}.{knob}": value for knob, value in setting.items()}
        named = {name: value for name, value in changed.items() if name in KNOBS}
        return {**work_knobs(self._settings, ingested(self._folders["ingest"])), **named}


def _untold(done: int, total: int, note: str = "") -> None:
    """Sweeps show no progress within a run."""


def _inputs(base: Base, declared: StageSweep, run: Run) -> dict[str, StageRef]:
    """What the stage is given: found in the store or made, on true bodies where the declaration says so."""
    subject = base.subject

    def call(stage: Stage, settings: Settings, inputs: Mapping[str, StageRef | Source], run: Run) -> StageRef:
        if stage.name == "perceive" and declared.true_bodies:
            named = {"capture": subject.truth, "ingest": inputs["ingest"]}
            return run_stage(truth_stage(base.capture), NoKnobs(), named, run)
        return call_directly(stage, settings, inputs, run)

    needs = declared.stage.needs
    made = process(subject.video, subject.settings("full"), run, only=needs, call=call)
    return {name: made.refs[name] for name in needs}


def whole_rows(
    base: Base, wanted: Sequence[tuple[Change, EvaluateRequest]], around: str, repeats: int, rows: Rows, told: Told
) -> None:
    """Whole runs on one capture, each scored against the truth.

    A run's seconds are the bills of its stages, those that another run of this sweep left in the store too. Every
    repeat has a store of its own, so that none finds what another has made.

    Args:
        base: the capture.
        wanted: what each row changes, and the request that it stands for.
        around: preset that rows are round unless they name another.
        repeats: runs of every setting; they make the same avatar, so the first is scored.
        rows: where rows are kept.
        told: called with a line on each run.
    """
    again = Path(base.request.out) / "repeats"
    stores = [base.store, *(ArtifactStore(again / str(number)) for number in range(2, repeats + 1))]
    for change, request in wanted:
        subjects = [replace(base, request=request, store=store).subject for store in stores]
        subject = subjects[0]
        chosen = subject.settings("full")
        versions = {stage.name: stage.version for stage in STAGES}
        asked = _prior(subject.run())
        made_of = _hash([chosen.model_dump(mode="json"), versions, asked, subject.truth.content_hash, request.size])
        name, setting = change.sweep(around), change.setting(around)
        if rows.reuse(made_of, name, setting, repeats):
            continue
        told(f"{base.capture.name}, end to end: {', '.join(f'{knob}={value}' for knob, value in setting.items())}")
        row = Measurement(name, setting, capture=base.capture.name, made_of=made_of)
        try:
            rows.add(_whole(row, subjects))
        except Exception as problem:  # a run that fails is a finding about that setting
            rows.add(replace(row, failed=f"{type(problem).__name__}: {problem}"))


def _prior(run: Run) -> str:
    """The prior's contents, or why there is none: retrained weights make another run."""
    return no_prior(run.prior, run.body, run.fills) or prior_role(run.prior).weights_sha256


def _whole(row: Measurement, subjects: Sequence[Subject]) -> Measurement:
    made = [stages_up_to(subject, "full", END, subject.run())[0].refs for subject in subjects]
    bills = [[ref.bill for ref in refs.values()] for refs in made]
    subject, refs = subjects[0], made[0]
    folders = {name: _folder(subject.store, refs[name]) for name in ("ingest", "avatar")}
    return replace(
        row,
        errors=whole_errors(load_avatar(folders["avatar"]), subject.capture, subject.request.size),
        wall_s=Spread.of([sum(bill.wall_s for bill in one) for one in bills]),
        cpu_s=Spread.of([sum(bill.cpu_s for bill in one) for one in bills]),
        peak_mb=Spread.of([max(bill.peak_rss_mb for bill in one) for one in bills]),
        knobs=work_knobs(subject.settings("full"), ingested(folders["ingest"])),
        parts=_parts(made),
    )


def _parts(made: Sequence[Mapping[str, StageRef]]) -> dict[str, float]:
    """Stage -> CPU seconds, a stage's parts taken together, the median over repeats."""
    spent: dict[str, list[float]] = {}
    for number, refs in enumerate(made):
        for ref in refs.values():
            one = spent.setdefault(ref.stage, [0.0] * len(made))
            one[number] += ref.bill.cpu_s
    return {stage: Spread.of(one).median for stage, one in spent.items()}


def _folder(store: ArtifactStore, ref: StageRef) -> Path:
    manifest = store.lookup(ref.key, stage=ref.stage, verify=False)
    assert manifest is not None  # it was made or found a moment ago
    return store.fetch(manifest)


def _hash(value: Any) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:16]
