"""One video's request, as a person or a queue states it, and what is set up from it."""

from __future__ import annotations

import os
import uuid
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal

import platformdirs
from pydantic import BaseModel, ConfigDict, Field, model_validator

from storage_schema.artifacts import ARTIFACTS, Blob
from storage_schema.store import ArtifactStore
from storage_schema.tables import Tables
from tasks.fills import fills_from_environment
from tasks.presets import PRESETS
from tasks.settings import Preset, Settings
from tasks.sources import fetch_source, policy_from_environment
from tasks.stage import Observer, Run, Source

_NAME = r"^[A-Za-z0-9][A-Za-z0-9._-]*$"


class VideoRequest(BaseModel):
    """Parameters of the flow `process_video`; the Prefect UI builds its form from this model."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    video: str = Field(description="path or address of a video (http, https, YouTube, s3, ...)")
    out: str | None = Field(None, description="folder for the avatar, the videos and the report; by default none")
    store: str | None = Field(None, description="URL of the artifact store; by default OUT/store")
    preset: Preset = Field("standard", description="how much time to spend")
    subject: Annotated[int, Field(ge=0)] | Literal["all"] | None = Field(
        None, description="which person, counted from the most visible, or all: one avatar each; by default 0"
    )
    start_s: float | None = Field(None, ge=0, description="first moment used, in seconds; by default the beginning")
    end_s: float | None = Field(None, gt=0, description="moment at which using stops; by default the end")
    stages: tuple[str, ...] | None = Field(None, description="only these stages and what they need; by default all")
    overrides: tuple[str, ...] = Field((), description="knobs, as STAGE.KNOB=VALUE")
    batch: str = Field("local", pattern=_NAME, description="name the rows are filed under")
    video_id: str | None = Field(None, pattern=_NAME, description="the video's id in its batch; by default one is made")
    attempt: int = Field(1, ge=1, description="which try at the video this is")
    stage_timeout_s: float = Field(7200.0, gt=0, description="seconds that one stage may take")

    @model_validator(mode="after")
    def _goes_somewhere(self) -> VideoRequest:
        if self.out is None and self.store is None:
            raise ValueError("expected a folder (out) or a store for the results, got neither; give one of them")
        return self

    def settings(self) -> Settings:
        """Return the preset with the subject, the time span and the overrides applied."""
        who = self.subject if isinstance(self.subject, int) else None
        named = {"perceive.subject": who, "ingest.start_s": self.start_s, "ingest.end_s": self.end_s}
        said = [f"{knob}={value!r}" for knob, value in named.items() if value is not None]
        return PRESETS[self.preset].with_overrides((*said, *self.overrides))

    def source(self) -> Source:
        """Bring the video to this machine and return it by content.

        Raises:
            BadInputError: it is refused, not there, or no single video.
            TransientError: it could not be fetched, for a reason that may pass.
        """
        video = str(Path(self.video).expanduser()) if self.video.startswith("~") else self.video
        return fetch_source(video, policy_from_environment(), source_cache())

    def open_store(self, artifacts: Mapping[str, Sequence[Blob]] = ARTIFACTS) -> ArtifactStore:
        """Open the store that the results go to."""
        return ArtifactStore(self.store or Path(self.out or ".") / "store", artifacts=artifacts)

    def id_of(self, source: Source) -> str:
        """Return the video's id: the one asked for, or one made of the file's name and content."""
        return self.video_id or f"{source.name}-{source.content_hash[:8]}"

    def run(self, video_id: str, observer: Observer, store: ArtifactStore | None = None) -> Run:
        """Name this attempt; its results go to `store`, opened here unless given.

        Raises:
            ModelError: what fills the roles on this machine is not stated as it should be.
        """
        store = store or self.open_store()
        run_id = uuid.uuid4().hex[:12]
        fills = fills_from_environment()
        return Run(
            store,
            Tables(store),
            self.batch,
            video_id,
            run_id,
            observer,
            fills.body(self.settings().body),
            attempt_number=self.attempt,
            prior=self.settings().prior,
            fills=fills,
        )


def source_cache() -> Path:
    """Where fetched videos are kept: `AHOY_SOURCE_CACHE`, or a folder of the user's cache."""
    chosen = os.environ.get("AHOY_SOURCE_CACHE")
    return Path(chosen) if chosen else Path(platformdirs.user_cache_dir("ahoy", appauthor=False)) / "sources"
