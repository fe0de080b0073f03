"""One stage of an earlier run again, alone, on inputs that the store kept; its output against the stored one."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ahoy_core.cost.meter import Bill, Meter
from ahoy_core.formats.npz import load_npz
from storage_schema.keys import file_sha256
from storage_schema.store import ArtifactStore, Manifest
from tasks.running import filled_by
from tasks.stage import ProgressFn, Run, Source, Stage, StageContext


@dataclass(frozen=True)
class FileComparison:
    """A file of the stored output beside the one made now: `same` bit for bit, and what differs in words."""

    name: str
    same: bool
    said: str


@dataclass(frozen=True)
class Replay:
    """What a replay gave.

    Attributes:
        stored: manifest of the output that was compared with.
        out: folder of the output made now.
        files: each compared.
        bill: of making it now; that of then is in the manifest's summary.
        changed: what is not as it was then: the stage's version, who fills a role.
    """

    stored: Manifest
    out: Path
    files: tuple[FileComparison, ...]
    bill: Bill
    changed: tuple[str, ...]

    @property
    def same(self) -> bool:
        """Whether every file is the same bit for bit."""
        return all(one.same for one in self.files)


def find_inputs(store: ArtifactStore, manifest: Manifest) -> dict[str, Manifest]:
    """Manifests of the artifacts that a stored one was made from, by input; the video itself is left out.

    Raises:
        FileNotFoundError: one is not in the store any more.
    """
    found = {}
    for name, content in manifest.inputs.items():
        if name in ("source", "skipped"):
            continue
        stage = name.partition("/")[0]
        # An input may stand in another stage's place: frames withheld from perception, a capture's truth.
        others = [one for one in store.backend.names("artifacts") if one != stage]
        inputs = (one for home in (stage, *others) for one in _manifests(store, home) if one.content_hash == content)
        if (match := next(inputs, None)) is None:
            raise FileNotFoundError(
                f"expected the input {name} of {manifest.stage} ({content[:12]}) in the store, got none; run it again"
            )
        found[name] = match
    return found


def _manifests(store: ArtifactStore, stage: str) -> list[Manifest]:
    keys = store.backend.names(f"artifacts/{stage}")
    found = (store.lookup(key, stage=stage, verify=False) for key in keys)
    return [manifest for manifest in found if manifest is not None]


def replay(
    stage: Stage,
    manifest: Manifest,
    run: Run,
    out: Path,
    progress: ProgressFn,
    source: Source | None = None,
    skipped: Mapping[str, str] | None = None,
) -> Replay:
    """Run a stage again with its stored configuration and inputs; nothing is written to the store.

    Args:
        stage: as it is now.
        manifest: of the output of then.
        run: the store, the body, the prior and the fills.
        out: an empty folder for the output.
        progress: told how far it is.
        source: the video, for a stage that reads it.
        skipped: what the run left out and why, for a stage that tells.

    Raises:
        ValueError: the video is needed and not given, or is another one.
        Exception: whatever the stage raises.
    """
    inputs = find_inputs(run.store, manifest)
    folders = {name: run.store.fetch(one) for name, one in inputs.items()}
    if "source" in manifest.inputs:
        if source is None or source.content_hash != manifest.inputs["source"]:
            raise ValueError(
                f"expected the video of {manifest.stage} ({manifest.inputs['source'][:12]}), got "
                f"{'none' if source is None else source.content_hash[:12]}; name its file with --video"
            )
        folders["source"] = source.path
    knobs = {name: value for name, value in manifest.config.items() if name != "item"}
    config = stage.config_type.model_validate(knobs)
    item = str(manifest.config.get("item", ""))
    ctx = StageContext(
        folders, inputs, out, progress, run.body, prior=run.prior, item=item, skipped=skipped or {}, fills=run.fills
    )
    with Meter() as meter:
        stage.run(config, ctx)
    stored = {blob.name: run.store.fetch(manifest, blob.name) for blob in manifest.blobs}
    files = tuple(_compared(name, path, out / name) for name, path in stored.items())
    return Replay(manifest, out, files, meter.read(), tuple(_changed(stage, config, manifest, run)))


def _changed(stage: Stage, config: Any, manifest: Manifest, run: Run) -> list[str]:
    found = []
    if stage.version != manifest.stage_version:
        found.append(f"version {manifest.stage_version} of the stage then, {stage.version} now")
    now = filled_by(stage, config, run)
    for role in sorted(set(now) | set(manifest.roles)):
        before, after = manifest.roles.get(role, {}), now.get(role)
        if before.get("weights_sha256") != (after.weights_sha256 if after else None):
            found.append(f"{role}: {before.get('name', 'nobody')} then, {after.name if after else 'nobody'} now")
    return found


def _compared(name: str, stored: Path, made: Path) -> FileComparison:
    if not made.is_file():
        return FileComparison(name, False, "not made this time")
    if file_sha256(stored) == file_sha256(made):
        return FileComparison(name, True, "the same, bit for bit")
    if name.endswith(".npz"):
        return FileComparison(name, False, _arrays(load_npz(stored), load_npz(made)))
    if name.endswith(".safetensors"):
        from safetensors.numpy import load_file

        return FileComparison(name, False, _arrays(load_file(stored), load_file(made)))
    if name.endswith(".json"):
        before, after = (json.loads(path.read_text(encoding="utf-8")) for path in (stored, made))
        if isinstance(before, dict) and isinstance(after, dict):
            keys = sorted(key for key in before.keys() | after.keys() if before.get(key) != after.get(key))
            return FileComparison(name, False, f"differs in {', '.join(keys) or 'its layout alone'}")
    return FileComparison(name, False, f"other bytes ({stored.stat().st_size} then, {made.stat().st_size} now)")


def _arrays(before: Mapping[str, np.ndarray], after: Mapping[str, np.ndarray]) -> str:
    said = []
    for key in sorted(before.keys() | after.keys()):
        if key not in before or key not in after:
            said.append(f"{key}: only {'then' if key in before else 'now'}")
        elif before[key].shape != after[key].shape:
            said.append(f"{key}: {before[key].shape} then, {after[key].shape} now")
        elif not np.array_equal(before[key], after[key], equal_nan=before[key].dtype.kind == "f"):
            if before[key].dtype.kind in "fiub":
                most = np.abs(before[key].astype(np.float64) - after[key].astype(np.float64)).max()
                said.append(f"{key}: up to {most:.3g} apart")
            else:
                said.append(f"{key}: differs")
    return "; ".join(said) or "equal arrays, stored otherwise"
