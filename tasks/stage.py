"""What a stage is: a value, not a class to inherit from.

A name, a version, a frozen configuration, what it needs, and a function from input folders to an output folder.
`tasks.running.run_stage` alone talks to the store on its behalf.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from pydantic import BaseModel, ConfigDict

from ahoy_core.body.load import PACKAGED
from ahoy_core.cost.meter import Bill
from storage_schema.store import ArtifactStore, Manifest
from storage_schema.tables import Tables
from tasks.fills import Fills
from tasks.role import Role as Role


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
    """Where a stage's function finds its inputs and puts its outputs, and who fills the roles.

    `item` is which of its items a mapped stage is at; `skipped` says, to a stage that explains, what was left out.
    """

    inputs: Mapping[str, Path]
    manifests: Mapping[str, Manifest]
    out: Path
    progress: ProgressFn
    body: str = PACKAGED
    show: Callable[[Path], None] = lambda picture: None
    prior: str = PACKAGED
    item: str = ""
    skipped: Mapping[str, str] = field(default_factory=dict)
    fills: Fills = field(default_factory=Fills)


class NoKnobs(BaseModel):
    """Of a stage that has none; its place in the settings keeps every stage alike."""

    model_config = ConfigDict(frozen=True, extra="forbid")


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
        wants: names of inputs that it uses where they were made, and does without where they were skipped.
        over: an input whose summary lists `items`: the stage is made once for each, with a key and an artifact of its
            own, so that a failure at one repeats none of the others.
        item: the item that this is made for; empty for a stage that is not mapped.
        obstacle: says why it has to be skipped, from the run and the summaries of its inputs; empty where it may run.
        explains: its output tells what was skipped and why, so its key knows.
        fillable: roles that `roles.yaml` may fill otherwise than `roles` says.
    """

    name: str
    version: int
    config_type: type[BaseModel]
    needs: tuple[str, ...]
    run: Callable[[Any, StageContext], StageOutput]
    roles: Callable[[Any], Mapping[str, Role]] = lambda config: {}
    slots: Callable[[Any], Sequence[str]] = lambda config: ()
    wants: tuple[str, ...] = ()
    over: str = ""
    item: str = ""
    obstacle: Callable[[Run, Mapping[str, Mapping[str, Any]]], str] | None = None
    explains: bool = False
    fillable: tuple[str, ...] = ()

    @property
    def title(self) -> str:
        """The name, and of a mapped stage the item."""
        return f"{self.name}/{self.item}" if self.item else self.name


@dataclass(frozen=True)
class StageRef:
    """A finished stage, by reference: what tasks pass to each other instead of data."""

    stage: str
    key: str
    content_hash: str
    state: str  # "done" made now, "cached" found in the store
    bill: Bill
    item: str = ""  # of a mapped stage

    @property
    def title(self) -> str:
        """The stage's name, and of a mapped one the item."""
        return f"{self.stage}/{self.item}" if self.item else self.stage

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
        prior: likewise, of the video model: a name or the path of a folder.
        skipped: stages left out so far, and why.
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
    prior: str = PACKAGED
    skipped: Mapping[str, str] = field(default_factory=dict)
    fills: Fills = field(default_factory=Fills)
