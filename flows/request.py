"""One video's request, as a person or a queue states it, and what is set up from it."""

from __future__ import annotations

import uuid
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field

from storage_schema.keys import file_sha256
from storage_schema.store import ArtifactStore
from storage_schema.tables import Tables
from tasks.presets import PRESETS
from tasks.settings import Preset, Settings
from tasks.stage import Observer, Run, Source


class VideoRequest(BaseModel):
    """Parameters of the flow `process_video`; the Prefect UI builds its form from this model."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    video: str = Field(description="path of a video file")
    out: str = Field(description="folder for the avatar, the videos and the report")
    store: str | None = Field(None, description="URL of the artifact store; by default OUT/store")
    preset: Preset = Field("standard", description="how much time to spend")
    subject: int | None = Field(None, ge=0, description="which person, counted from the most visible; by default 0")
    stages: tuple[str, ...] | None = Field(None, description="only these stages and what they need; by default all")
    overrides: tuple[str, ...] = Field((), description="knobs, as STAGE.KNOB=VALUE")
    batch: str = Field("local", pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$", description="name the rows are filed under")

    def settings(self) -> Settings:
        """Return the preset with the subject and the overrides applied."""
        chosen = PRESETS[self.preset]
        if self.subject is not None:
            chosen = chosen.with_overrides([f"perceive.subject={self.subject}"])
        return chosen.with_overrides(self.overrides)

    def source(self) -> Source:
        """Return the video by content.

        Raises:
            FileNotFoundError: there is no such file.
        """
        path = Path(self.video).expanduser()
        if not path.is_file():
            raise FileNotFoundError(f"expected a video file, got {self.video!r}, which is not there; check the path")
        return Source(path, file_sha256(path))

    def run(self, source: Source, observer: Observer) -> Run:
        """Open the store and name this attempt."""
        store = ArtifactStore(self.store or Path(self.out) / "store")
        video_id = f"{Path(self.video).stem[:40]}-{source.content_hash[:8]}"
        return Run(store, Tables(store), self.batch, video_id, uuid.uuid4().hex[:12], observer, self.settings().body)
