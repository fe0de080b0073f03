"""Six stages that do next to nothing, in the real flow: what is left is what the queue costs."""

from __future__ import annotations

import time
from typing import Any

from flows.process_video import as_flow
from storage_schema.artifacts import Blob
from tasks.settings import Settings
from tasks.stage import Stage, StageContext, StageOutput

HOLD = b"hold "  # a video that begins so is at work for an hour
NAMES = ("ingest", "perceive", "texture", "coarse", "animate", "report")


def _stage(name: str, need: str) -> Stage:
    def run(config: Any, ctx: StageContext) -> StageOutput:
        given = ctx.inputs[need]
        text = (given if given.is_file() else given / "out.txt").read_bytes()
        if text.startswith(HOLD):
            time.sleep(3600)
        (ctx.out / "out.txt").write_bytes(text)
        return StageOutput()

    return Stage(name, 1, Settings.model_fields[name].annotation, (need,), run)  # type: ignore[arg-type]


STAGES = tuple(_stage(name, need) for name, need in zip(NAMES, ("source", *NAMES), strict=False))
ARTIFACTS = {name: (Blob("out.txt"),) for name in NAMES}

process_video = as_flow(STAGES, ARTIFACTS)
