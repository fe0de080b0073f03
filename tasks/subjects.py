"""Stage `subjects`: everybody in a clip, on a sheet; for `ahoy run --list-subjects` and `--subject all`."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping

import torch
from pydantic import BaseModel, ConfigDict

from ahoy_core.formats.images import write_png
from ahoy_core.formats.npz import load_npz
from ahoy_core.perceive.networks import FULL, files_of
from ahoy_core.perceive.people import find_people, subject_sheet, subjects, worthwhile
from ahoy_core.perceive.tracking import NoPersonError
from tasks.roles import landmark_networks, networks
from tasks.stage import Role, Stage, StageContext, StageOutput


class SubjectsConfig(BaseModel):
    """No knobs: what is found does not depend on any."""

    model_config = ConfigDict(frozen=True, extra="forbid")


def run_subjects(config: SubjectsConfig, ctx: StageContext) -> StageOutput:
    """Detect and link people, and draw them."""
    video = load_npz(ctx.inputs["ingest"] / "frames.npz")
    nets = landmark_networks(threads=torch.get_num_threads())
    total, done = len(video["frames"]), 0

    def tick(note: str) -> None:
        nonlocal done
        done += 1
        ctx.progress(done, total, note)

    people = find_people(nets, video["frames"], video["shot"], tick)
    if not people:
        raise NoPersonError(f"expected a person in at least one of {total} frames, got none; use another clip")
    found = [dataclasses.asdict(subject) for subject in subjects(people, video["shot"])]
    facts = {"subjects": found, "worthwhile": worthwhile(people)}
    (ctx.out / "subjects.json").write_text(json.dumps(facts, indent=1), encoding="utf-8")
    write_png(ctx.out / "subjects.png", subject_sheet(video["frames"], people))
    return StageOutput({"facts": {"people": len(people)}}, ("subjects.png",))


def _roles(config: SubjectsConfig) -> Mapping[str, Role]:
    return {"pose": networks(files_of(FULL))}


SUBJECTS = Stage("subjects", 2, SubjectsConfig, ("ingest",), run_subjects, _roles)
