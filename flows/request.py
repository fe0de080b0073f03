"""One video's request, as a person or a queue states it, and what is set up from it."""

from __future__ import annotations

import os
import uuid
from pathlib import Path
from typing import Annotated, Literal

import platformdirs
from pydantic import BaseModel, ConfigDict, Field

from storage_schema.store import ArtifactStore
from storage_schema.tables import Tables
from tasks.presets import PRESETS
from tasks.settings import Preset, Settings
from tasks.sources import fetch_source, policy_from_environment
from tasks.stage import Observer, Run, Source


class VideoRequest(BaseModel):
    """Parameters of the flow `process_video`; the Prefect UI builds its form from this model."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    video: str = Field(description="path or address of a video (http, https, YouTube, s3, ...)")
    out: str = Field(description="folder for the avatar, the videos and the report")
    store: str | None = Field(None, description="URL of the artifact store; by default OUT/store")
    preset: Preset = Field("standard", description="how much time to spend")
    subject: Annotated[int, Field(ge=0)] | Literal["all"] | None = Field(
        None, description="which person, counted from the most visible, or all: one avatar each; by default 0"
    )
    start_s: float | None = Field(None, ge=0, description="first moment used, in seconds; by default the beginning")
    end_s: float | None = Field(None, gt=0, description="moment at which using stops; by default the end")
    stages: tuple[str, ...] | None = Field(None, description="only these stages and what they need; by default all")
    overrides: tuple[str, ...] = Field((), description="knobs, as STAGE.KNOB=VALUE")
    batch: str = Field("local", pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$", description="name the rows are filed under")

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

    def run(self, source: Source, observer: Observer) -> Run:
        """Open the store and name this attempt."""
        store = ArtifactStore(self.store or Path(self.out) / "store")
        video_id = f"{source.name}-{source.content_hash[:8]}"
        return Run(store, Tables(store), self.batch, video_id, uuid.uuid4().hex[:12], observer, self.settings().body)


def source_cache() -> Path:
    """Where fetched videos are kept: `AHOY_SOURCE_CACHE`, or a folder of the user's cache."""
    chosen = os.environ.get("AHOY_SOURCE_CACHE")
    return Path(chosen) if chosen else Path(platformdirs.user_cache_dir("ahoy", appauthor=False)) / "sources"
