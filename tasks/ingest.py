"""Stage `ingest`: the video file -> upright frames of a workable size, with times and shots."""

from __future__ import annotations

import json

from ahoy_core.formats.npz import save_npz
from ahoy_core.ingest import IngestConfig, ingest
from tasks.stage import Stage, StageContext, StageOutput


def run_ingest(config: IngestConfig, ctx: StageContext) -> StageOutput:
    """Read the video; see `ahoy_core.ingest.ingest` for what is refused and why."""
    result = ingest(ctx.inputs["source"], config, lambda done, total: ctx.progress(done, total, "frames"))
    save_npz(ctx.out / "frames.npz", result.arrays(), compress=True)
    notes = result.summary()
    (ctx.out / "probe.json").write_text(json.dumps(notes, indent=1), encoding="utf-8")
    probe = result.probe
    facts = {
        "size": f"{probe.width} x {probe.height}, kept at {notes['width']} x {notes['height']}",
        "frames": f"{notes['frames']} kept, {result.pts[-1] - result.pts[0]:.2f} s, {notes['shots']} shot(s)",
        "coding": f"{probe.codec}, {probe.pix_fmt}, {probe.container}",
    }
    return StageOutput(summary={"facts": facts, "notes": notes["notes"]})


INGEST = Stage("ingest", 1, IngestConfig, ("source",), run_ingest)
