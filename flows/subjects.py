"""Several people in one video: who is there, and one run for each of them."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flows.pipeline import Call, call_directly
from tasks.ingest import INGEST
from tasks.running import run_stage
from tasks.settings import Settings
from tasks.stage import Run, Source
from tasks.subjects import SUBJECTS, SubjectsConfig

SHEET = "subjects.png"


@dataclass(frozen=True)
class People:
    """Who was found: rows of `ahoy_core.perceive.people.Subject`, the numbers worth an avatar, and the sheet's file."""

    subjects: list[Mapping[str, Any]]
    worthwhile: list[int]
    sheet: Path


def list_people(source: Source, settings: Settings, run: Run, call: Call = call_directly) -> People:
    """Find everybody in a video.

    Args:
        source: the video.
        settings: of the run; ingest's knobs decide which frames are looked at.
        run: where artifacts and rows go.
        call: how to run the first stage.
    """
    frames = call(INGEST, settings, {"source": source}, run)
    ref = run_stage(SUBJECTS, SubjectsConfig(), {"ingest": frames}, run)
    manifest = run.store.lookup(ref.key, stage=SUBJECTS.name)
    if manifest is None:
        raise FileNotFoundError("expected the list of people in the store, got none; run the same command again")
    folder = run.store.fetch(manifest)
    facts = json.loads((folder / "subjects.json").read_text(encoding="utf-8"))
    return People(facts["subjects"], facts["worthwhile"], folder / SHEET)


def deliver_sheet(people: People, out: Path) -> Path:
    """Copy the sheet to the folder that was asked for."""
    out.mkdir(parents=True, exist_ok=True)
    return Path(shutil.copyfile(people.sheet, out / SHEET))


def each_subject(
    wanted: int | str | None, source: Source, settings: Settings, run: Run, call: Call = call_directly
) -> list[tuple[str, Settings, Run]]:
    """The run itself, or with `all` one for everybody worth an avatar.

    Returns:
        For each: what its results' names begin with, its settings, its run.
    """
    if wanted != "all":
        return [("", settings, run)]
    worthwhile = list_people(source, settings, run, call).worthwhile
    return [(f"person{number}/", *for_subject(settings, run, number)) for number in worthwhile]


def for_subject(settings: Settings, run: Run, number: int) -> tuple[Settings, Run]:
    """The same run for one person, with a name of its own."""
    chosen = settings.with_overrides([f"perceive.subject={number}"])
    return chosen, dataclasses.replace(run, video_id=f"{run.video_id}-person{number}")
