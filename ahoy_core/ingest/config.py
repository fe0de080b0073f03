"""What may be chosen when a video is read in."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field, model_validator

from ahoy_core.ingest.shots import ShotConfig


class IngestConfig(BaseModel):
    """Which frames are kept, and at what size.

    Attributes:
        max_size: longest side in pixels; larger pictures are reduced with an area filter while they are decoded,
            smaller ones stay as they are.
        start_s: first moment that is kept, seconds from the first frame.
        end_s: moment at which keeping stops (not kept itself); None for the end of the video.
        stride: of the frames in that range, keep every `stride`-th, beginning with the first.
        max_frames: keep at most so many. If there are more, they are thinned evenly over the whole range (neighbouring
            gaps differ by at most one frame), because a person turns in the course of a video and its beginning would
            show one side only. None for no limit.
        shots: how cuts are found.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    max_size: int = Field(default=512, ge=16, le=8192)
    start_s: float = Field(default=0.0, ge=0.0, allow_inf_nan=False)
    end_s: float | None = Field(default=None, gt=0.0, allow_inf_nan=False)
    stride: int = Field(default=1, ge=1)
    max_frames: int | None = Field(default=300, ge=1)
    shots: ShotConfig = ShotConfig()

    @model_validator(mode="after")
    def _ordered(self) -> IngestConfig:
        if self.end_s is not None and self.end_s <= self.start_s:
            raise ValueError(f"expected end_s after start_s, got {self.end_s} and {self.start_s}: swap or drop one")
        return self
