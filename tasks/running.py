"""The one way to run a stage: look it up, or make it and commit it.

Every stage gets keys, leases, verification, the ledger and its bill the same way, with or without an orchestrator.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from contextlib import AbstractContextManager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from ahoy_core.cost.meter import Bill, Meter
from storage_schema.keys import stage_key
from storage_schema.store import ArtifactStore, Manifest
from tasks.errors import message_of
from tasks.prior_folder import fills_prior, prior_role
from tasks.role import Role
from tasks.roles import body_role
from tasks.stage import Run, Source, Stage, StageContext, StageOutput, StageRef

LEASE_S = (
    60.0  # a killed worker's stage may be taken over after this; the holder renews it; correctness does not rest on it
)
WAIT_S = 3600.0  # longer than any stage: somebody else at work on the same key is waited for, not raced


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
    hashes = {name: value.content_hash for name, value in inputs.items()}
    if stage.explains and run.skipped:
        hashes["skipped"] = hashlib.sha256(json.dumps(run.skipped, sort_keys=True).encode()).hexdigest()
    roles = {role: dataclasses.asdict(filled) for role, filled in filled_by(stage, config, run).items()}
    key = stage_key(
        stage.name,
        stage.version,
        _knobs(stage, config),
        hashes,
        {r: v["weights_sha256"] for r, v in roles.items() if v["weights_sha256"]},
    )
    run.observer.started(stage.title)
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
    ref = StageRef(stage.name, key, manifest.content_hash, state, Bill(**manifest.summary["bill"]), stage.item)
    if state == "cached":
        run.tables.append("stages", [_row(run, stage, config, key, "cached", started, Bill())], batch=run.batch)
    run.observer.finished(ref, run.store.fetch(manifest))
    return ref


def filled_by(stage: Stage, config: BaseModel, run: Run) -> dict[str, Role]:
    """Who fills the stage's roles; body and prior are the run's."""
    filled_by = run.fills.filled(stage.roles(config), stage.fillable)
    if "body" in filled_by:
        filled_by["body"] = body_role(run.body)
    if "video" in filled_by and not fills_prior(run.prior, run.fills):
        filled_by["video"] = prior_role(run.prior)
    return filled_by


def _knobs(stage: Stage, config: BaseModel) -> dict[str, Any]:
    return config.model_dump(mode="json") | ({"item": stage.item} if stage.item else {})


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
    manifests, folders = resolve_inputs(stage, inputs, run.store)
    meter = Meter()
    try:
        with run.store.attempt(key, stage.name) as attempt, meter:

            def progress(done: int, total: int, note: str = "") -> None:
                run.observer.progress(stage.title, done, total, note)

            def show(picture: Path) -> None:
                run.observer.showed(stage.title, picture)

            ctx = StageContext(
                folders, manifests, attempt.dir, progress, run.body, show, run.prior, stage.item, run.skipped, run.fills
            )
            output = stage.run(config, ctx)
            bill = meter.read()
            manifest = attempt.commit(
                stage_version=stage.version,
                config=_knobs(stage, config),
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


def resolve_inputs(
    stage: Stage, inputs: Mapping[str, StageRef | Source], store: ArtifactStore
) -> tuple[dict[str, Manifest], dict[str, Path]]:
    """Manifests and folders of a stage's inputs.

    Raises:
        FileNotFoundError: an artifact is not whole in the store.
    """
    manifests: dict[str, Manifest] = {}
    folders: dict[str, Path] = {}
    for name, value in inputs.items():
        if isinstance(value, Source):
            folders[name] = value.path
            continue
        manifest = store.lookup(value.key, stage=value.stage)
        if manifest is None:
            raise FileNotFoundError(
                f"stage {stage.title}: expected the artifact of {name} ({value.key[:12]}) whole in the store, got "
                f"none; run {name} again: it makes the artifact anew"
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
        "knobs": _knobs(stage, config) if config is not None else None,
        "attempt_number": run.attempt_number,
        "seq": next(run.sequence),
    }
