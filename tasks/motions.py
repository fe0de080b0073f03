"""Stage `motions`: which structured motions are worth hallucinating, from what the video left unseen (paper 3.2)."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict, Field

from ahoy_core.body.load import load_body
from ahoy_core.conventions import Cameras
from ahoy_core.formats.npz import load_npz, save_npz
from ahoy_core.prior.framing import HEIGHT, WIDTH
from ahoy_core.prior.sequences import FRAMES, MIN_UNSEEN, MotionPlan, PlannedSequence, plan_motions
from ahoy_core.texture.surface import Surface
from ahoy_core.texture.texels import face_coverage, texel_map
from tasks.complete import lost
from tasks.roles import packaged_body
from tasks.stage import Role, Stage, StageContext, StageOutput


class MotionsConfig(BaseModel):
    """How much is hallucinated."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    frames: int = Field(default=FRAMES, ge=2, description="of each sequence")
    limit: int = Field(default=3, ge=0, description="sequences at most")
    min_unseen: float = Field(default=MIN_UNSEEN, ge=0, description="share of the body that one must show anew")


def run_motions(config: MotionsConfig, ctx: StageContext) -> StageOutput:
    """Plan, and say of every motion why it is there or not."""
    body = load_body(ctx.body)
    atlas = load_npz(ctx.inputs["texture"] / "atlas.npz", ["coverage"])["coverage"]
    betas = torch.from_numpy(load_npz(ctx.inputs["perceive"] / "body.npz", ["betas"])["betas"]).float()
    surface = Surface.of(body)
    coverage = face_coverage(atlas, texel_map(surface, len(atlas)), surface)
    plan = plan_motions(body, betas, torch.from_numpy(coverage).float(), config.frames, config.limit, config.min_unseen)
    save_npz(ctx.out / "motions.npz", _arrays(plan, config.frames, len(body.joint_names)))
    reasons = {sequence.name: sequence.reason for sequence in plan.sequences}
    told = {
        "sequences": [{"name": s.name, "kind": s.kind, "reason": s.reason} for s in plan.sequences],
        "dropped": plan.dropped,
    }
    (ctx.out / "motions.json").write_text(json.dumps(told, indent=1), encoding="utf-8")
    facts = {**reasons, **{name: f"left out: {why}" for name, why in plan.dropped.items()}}
    return StageOutput({"facts": facts, "items": [slug(s.name) for s in plan.sequences]})


def slug(name: str) -> str:
    """A sequence's name as an item: letters and dashes."""
    return name.replace(" ", "-")


def read_sequence(folder: Path, item: str) -> PlannedSequence:
    """One sequence of a plan.

    Raises:
        KeyError: the plan holds no such sequence.
    """
    told = json.loads((folder / "motions.json").read_text(encoding="utf-8"))["sequences"]
    numbers = {slug(sequence["name"]): number for number, sequence in enumerate(told)}
    if item not in numbers:
        raise KeyError(f"expected one of {sorted(numbers)}, got {item!r}; plan the motions again")
    row = numbers[item]
    arrays = {
        name: torch.from_numpy(np.asarray(value[row])) for name, value in load_npz(folder / "motions.npz").items()
    }
    return PlannedSequence(
        name=told[row]["name"],
        kind=told[row]["kind"],
        map_pose=arrays["map_pose"],
        pose=arrays["pose"],
        transl=arrays["transl"],
        cameras=Cameras(arrays["viewmats"], arrays["Ks"], WIDTH, HEIGHT),
        unseen=float(arrays["unseen"]),
        reason=told[row]["reason"],
    )


def _arrays(plan: MotionPlan, frames: int, joints: int) -> dict[str, np.ndarray]:
    shapes = {
        "map_pose": (joints, 3),
        "pose": (frames, joints, 3),
        "transl": (frames, 3),
        "viewmats": (frames, 4, 4),
        "Ks": (frames, 3, 3),
        "unseen": (),
    }
    arrays = {name: np.zeros((len(plan.sequences), *shape), np.float32) for name, shape in shapes.items()}
    for row, sequence in enumerate(plan.sequences):
        for name in ("map_pose", "pose", "transl"):
            arrays[name][row] = getattr(sequence, name).numpy()
        arrays["viewmats"][row], arrays["Ks"][row] = sequence.cameras.viewmats.numpy(), sequence.cameras.Ks.numpy()
        arrays["unseen"][row] = sequence.unseen
    return arrays


def _roles(config: MotionsConfig) -> Mapping[str, Role]:
    return {"body": packaged_body()}


MOTIONS = Stage("motions", 1, MotionsConfig, ("perceive", "texture", "complete"), run_motions, _roles, obstacle=lost)
