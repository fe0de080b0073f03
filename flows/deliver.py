"""Puts what a person wants from a run where they asked for it: out of the store, under plain names."""

from __future__ import annotations

import shutil
from pathlib import Path

from flows.pipeline import Outcome
from tasks.stage import Run

DELIVERED = {
    "avatar": ("avatar.safetensors", "avatar.json"),
    "animate": ("avatar.ply", "turntable.mp4", "motion.mp4", "turntable.png"),
    "report": ("report.html",),
}


def deliver(outcome: Outcome, run: Run, out: str | Path) -> dict[str, Path]:
    """Copy the finished files to `out/<video id>/` and return their paths by file name."""
    folder = Path(out) / run.video_id
    folder.mkdir(parents=True, exist_ok=True)
    paths: dict[str, Path] = {}
    for stage, names in DELIVERED.items():
        if stage not in outcome.refs:
            continue
        manifest = run.store.lookup(outcome.refs[stage].key, stage=stage, verify=False)
        if manifest is None:
            raise FileNotFoundError(
                f"expected the artifact of {stage} in the store, got none; run the same command again"
            )
        for name in names:
            paths[name] = folder / name
            partial = folder / f".{name}.partial"
            shutil.copyfile(run.store.fetch(manifest, name), partial)
            partial.replace(paths[name])
    return paths
