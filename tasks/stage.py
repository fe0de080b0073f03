"""What a stage is, and the one way to run it: look it up, or make it and commit it.

A stage is a value (`Stage`), not a class to inherit from: a name, a version, a frozen configuration, what it needs,
and a function from input folders to an output folder. `run_stage` alone talks to the store on its behalf, so every
stage gets keys, leases, verification, the ledger and its bill the same way, with or without an orchestrator.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Protocol

from pydantic import BaseModel

from ahoy_core.body.load import PACKAGED
from ahoy_core.cost.meter import Bill, Meter
from storage_schema.keys import stage_key
from storage_schema.store import ArtifactStore, Manifest
from storage_schema.tables import Tables
from tasks.errors import message_of
from tasks.fills import Fills
from tasks.role import Role as Role
from tasks.roles import body_role

LEASE_S = (
    60.0  # a killed worker's stage may be taken over after this; the holder renews it; correctness does not rest on it
)
WAIT_S = 3600.0  # longer than any stage: somebody else at work on the same key is waited for, not raced


class ProgressFn(Protocol):
    """Called by a stage as it goes: `done` of `total` units, and a word on what they are."""

    def __call__(self, done: int, total: int, note: str = "") -> None:
        """Say how far the stage is."""


class Observer(Protocol):
    """Who watches a run: the terminal's progress bars, or Prefect's run page."""

    def started(self, stage: str) -> None:
        """Called once, before anything else is known of the stage."""

    def progress(self, stage: str, done: int, total: int, note: str) -> None:
        """Called as often as the stage likes."""

    def showed(self, stage: str, picture: Path) -> None:
        """Called with a PNG of how a long stage is doing, while it runs."""

    def finished(self, ref: StageRef, folder: Path) -> None:
        """Called once the artifact is whole in the store; `folder` holds its files."""


@dataclass(frozen=True)
class StageOutput:
    """What a stage's function returns beside the files it wrote.

    Attributes:
        summary: JSON results for the report and the ledger (scores, counts, notes).
        pictures: blob names worth showing on a run page.
        frames: rows for the `frames` table, without the identifiers that `run_stage` adds.
        metrics: rows for the `metrics` table, likewise.
    """

    summary: dict[str, Any] = field(default_factory=dict)
    pictures: tuple[str, ...] = ()
    frames: Sequence[dict[str, Any]] = ()
    metrics: Sequence[dict[str, Any]] = ()


@dataclass(frozen=True)
class StageContext:
    """Where a stage's function finds its inputs and puts its outputs, and who fills the roles."""

    inputs: Mapping[str, Path]
    manifests: Mapping[str, Manifest]
    out: Path
    progress: ProgressFn
    body: str = PACKAGED
    show: Callable[[Path], None] = lambda picture: None
    fills: Fills = field(default_factory=Fills)


@dataclass(frozen=True)
class Stage:
    """One step from the video to the avatar.

    Attributes:
        name: also the folder in the store, the row in the ledger and the name of the Prefect task.
        version: raise it when the stage's code changes what it makes; every key changes with it.
        needs: names of the inputs; an upstream stage, or `source` for the video itself.
        run: writes the files that `storage_schema.artifacts.ARTIFACTS[name]` declares into `ctx.out`.
        roles: who fills which role under a configuration.
        slots: names of scarce resources (`gpu`, `download`) that making it takes one slot each of, under a
            configuration; a stage that is found in the store takes none.
        fillable: roles that `roles.yaml` may fill otherwise than `roles` says.
    """

    name: str
    version: int
    config_type: type[BaseModel]
    needs: tuple[str, ...]
    run: Callable[[Any, StageContext], StageOutput]
    roles: Callable[[Any], Mapping[str, Role]] = lambda config: {}
    slots: Callable[[Any], Sequence[str]] = lambda config: ()
    fillable: tuple[str, ...] = ()


@dataclass(frozen=True)
class StageRef:
    """A finished stage, by reference: what tasks pass to each other instead of data."""

    stage: str
    key: str
    content_hash: str
    state: str  # "done" made now, "cached" found in the store
    bill: Bill

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values, for an orchestrator to carry."""
        return dataclasses.asdict(self)

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> StageRef:
        """Inverse of `to_json`."""
        return cls(**{**value, "bill": Bill(**value["bill"])})


@dataclass(frozen=True)
class Source:
    """The video file itself, as an input: known by its content, wherever it lies.

    Attributes:
        name: short and harmless, for folders and tables.
        origin: where it came from, for people; without credentials.
    """

    path: Path
    content_hash: str
    name: str = "video"
    origin: str = ""


@dataclass(frozen=True)
class Run:
    """One attempt at one video: where its artifacts and rows go, who watches, and who fills the roles.

    Attributes:
        body: a name or the path of a file; keys know it by its contents alone, so it is no knob of a stage.
        take_slots: waits for one slot of each named resource and holds them while its block runs.
        attempt_number: of the video in its batch, from 1.
        sequence: numbers the rows of this run, so that their order does not rest on a clock.
        fills: roles that something else than the embedded default fills.
    """

    store: ArtifactStore
    tables: Tables
    batch: str
    video_id: str
    run_id: str
    observer: Observer
    body: str = PACKAGED
    take_slots: Callable[[Sequence[str]], AbstractContextManager[Any]] = lambda names: nullcontext()
    attempt_number: int = 1
    sequence: Iterator[int] = field(default_factory=itertools.count)
    fills: Fills = field(default_factory=Fills)


def run_stage(stage: Stage, config: BaseModel, inputs: Mapping[str, StageRef | Source], run: Run) -> StageRef:
    """Return the stage's artifact, made now unless the store already holds it whole.

    Raises:
        Whatever the stage raises; the failure is in the ledger by then, and nothing half-made is in the store.
    """
    missing = set(stage.needs) - set(inputs)
    if missing:
        raise ValueError(
            f"stage {stage.name}: expected inputs {stage.needs}, got no {sorted(missing)}; run those stages first"
        )
    hashes = {name: inputs[name].content_hash for name in stage.needs}
    filled_by = run.fills.filled(stage.roles(config), stage.fillable)
    if "body" in filled_by:
        filled_by["body"] = body_role(run.body)
    roles = {role: dataclasses.asdict(filled) for role, filled in filled_by.items()}
    key = stage_key(
        stage.name,
        stage.version,
        config.model_dump(mode="json"),
        hashes,
        {r: v["weights_sha256"] for r, v in roles.items() if v["weights_sha256"]},
    )
    run.observer.started(stage.name)
    started = datetime.now(UTC)
    manifest = run.store.lookup(key, stage=stage.name)
    state = "cached"
    if manifest is None:
        with _lease(run, key):
            manifest = run.store.lookup(key, stage=stage.name)  # whoever held the lease may just have made it
            if manifest is None:
                state = "done"
                # The lease first: whoever holds a slot never waits for a lease, so nobody waits in a circle.
                with run.take_slots((*stage.slots(config), *run.fills.slots(stage.fillable))):
                    manifest = _make(stage, config, inputs, run, key, hashes, roles, started)
    ref = StageRef(stage.name, key, manifest.content_hash, state, Bill(**manifest.summary["bill"]))
    if state == "cached":
        run.tables.append("stages", [_row(run, stage, config, key, "cached", started, Bill())], batch=run.batch)
    run.observer.finished(ref, run.store.fetch(manifest))
    return ref


def skip_stage(stage: Stage, reason: str, run: Run) -> None:
    """Record that a stage was not run, and why; the report shows the reason."""
    row = _row(run, stage, None, None, "skipped", datetime.now(UTC), Bill())
    run.tables.append("stages", [{**row, "reason": reason}], batch=run.batch)


def _lease(run: Run, key: str) -> AbstractContextManager[Any]:
    return run.store.lease(key, owner=run.run_id, ttl_s=LEASE_S, wait_s=WAIT_S)


def _make(
    stage: Stage,
    config: BaseModel,
    inputs: Mapping[str, StageRef | Source],
    run: Run,
    key: str,
    hashes: dict[str, str],
    roles: dict[str, dict[str, Any]],
    started: datetime,
) -> Manifest:
    manifests, folders = _resolve(stage, inputs, run.store)
    meter = Meter()
    try:
        with run.store.attempt(key, stage.name) as attempt, meter:

            def progress(done: int, total: int, note: str = "") -> None:
                run.observer.progress(stage.name, done, total, note)

            def show(picture: Path) -> None:
                run.observer.showed(stage.name, picture)

            output = stage.run(
                config, StageContext(folders, manifests, attempt.dir, progress, run.body, show, run.fills)
            )
            bill = meter.read()
            manifest = attempt.commit(
                stage_version=stage.version,
                config=config.model_dump(mode="json"),
                inputs=hashes,
                roles=roles,
                summary={**output.summary, "pictures": list(output.pictures), "bill": dataclasses.asdict(bill)},
            )
    except BaseException as error:
        row = _row(run, stage, config, key, "failed", started, meter.read()) | {
            "error_class": type(error).__name__,
            "error_message": message_of(error),
        }
        run.tables.append("stages", [row], batch=run.batch)
        raise
    row = _row(run, stage, config, key, "done", started, bill) | {"attempt": manifest.attempt}
    run.tables.append("stages", [row], batch=run.batch)
    upstream = {role: who for m in manifests.values() for role, who in m.roles.items()}
    _append_results(run, key, output, {role: who["name"] for role, who in {**upstream, **roles}.items()})
    return manifest


def _resolve(
    stage: Stage, inputs: Mapping[str, StageRef | Source], store: ArtifactStore
) -> tuple[dict[str, Manifest], dict[str, Path]]:
    manifests: dict[str, Manifest] = {}
    folders: dict[str, Path] = {}
    for name in stage.needs:
        value = inputs[name]
        if isinstance(value, Source):
            folders[name] = value.path
            continue
        manifest = store.lookup(value.key, stage=value.stage)
        if manifest is None:
            raise FileNotFoundError(
                f"stage {stage.name}: expected the artifact of {name} ({value.key[:12]}) whole in the store, got none; "
                f"run {name} again: it makes the artifact anew"
            )
        manifests[name], folders[name] = manifest, store.fetch(manifest)
    return manifests, folders


def _append_results(run: Run, key: str, output: StageOutput, filled_by: Mapping[str, str]) -> None:
    for table, rows in (("frames", output.frames), ("metrics", output.metrics)):
        if rows:
            more = {"capture": run.video_id, "roles": dict(filled_by)} if table == "metrics" else {}
            who = {"video_id": run.video_id, "key": key} | more
            run.tables.append(table, [{**who, **row} for row in rows], batch=run.batch)


def _row(
    run: Run, stage: Stage, config: BaseModel | None, key: str | None, state: str, started: datetime, bill: Bill
) -> dict[str, Any]:
    return {
        "batch": run.batch,
        "video_id": run.video_id,
        "run_id": run.run_id,
        "key": key,
        "stage": stage.name,
        "stage_version": stage.version,
        "state": state,
        "started_at": started,
        "wall_s": bill.wall_s,
        "cpu_s": bill.cpu_s,
        "peak_rss_mb": bill.peak_rss_mb,
        "knobs": config.model_dump(mode="json") if config is not None else None,
        "attempt_number": run.attempt_number,
        "seq": next(run.sequence),
    }
