"""Stage `withhold`: perception with some frames marked unused, so that no later stage learns from them.

The paper's protocol for videos without other cameras: what is compared is a frame that the avatar never saw. Its pose
and mask come from the frame itself, so perception alone looks at it.
"""

from __future__ import annotations

import shutil

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from ahoy_core.formats.npz import load_npz, save_npz
from tasks.stage import Stage, StageContext, StageOutput


class WithholdConfig(BaseModel):
    """Every `every`-th usable frame is withheld, beginning in the middle of the first stretch."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    every: int = Field(default=8, ge=2)


def withheld(used: np.ndarray, every: int) -> list[int]:
    """Numbers of the frames that are withheld, of those with a person (`used` [T] bool)."""
    return [int(number) for number in np.flatnonzero(used)[every // 2 :: every]]


def run_withhold(config: WithholdConfig, ctx: StageContext) -> StageOutput:
    """Copy the artifact of perceive, with the withheld frames unused."""
    source = ctx.inputs["perceive"]
    fit = load_npz(source / "body.npz")
    numbers = withheld(fit["used"], config.every)
    fit["used"] = fit["used"].copy()
    fit["used"][numbers] = False
    save_npz(ctx.out / "body.npz", fit)
    for name in ("masks.npz", "overlay.png", "fit.json"):
        shutil.copyfile(source / name, ctx.out / name)
    return StageOutput({"facts": {"frames withheld": len(numbers)}})


WITHHOLD = Stage("withhold", 1, WithholdConfig, ("perceive",), run_withhold)
