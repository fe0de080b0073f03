"""What may be chosen when something is scored."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator

from ahoy_core.metrics.protocol import PROTOCOLS

InputSetting = Literal["video", "first occluded frame", "canonical image"]
"""What was handed to the method: the video, or one of the two pictures that the paper gives to other systems."""


class EvaluateConfig(BaseModel):
    """One cell: a capture under a configuration.

    Attributes:
        capture: its name.
        config: name of the configuration, as it stands in the rows.
        protocols: names of the protocols; those that the capture has no truth for are left out, and that is noted.
        size: longest side, in pixels, of what is compared: larger truth is reduced by an area filter, smaller stays.
        input: what the method was given beside the video, for the protocol id.
        input_setting: see `InputSetting`.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    capture: str
    config: str
    protocols: tuple[str, ...] = tuple(PROTOCOLS)
    size: int = Field(default=256, ge=32, le=4096)
    input: str = ""
    input_setting: InputSetting = "video"

    @field_validator("protocols")
    @classmethod
    def _known(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        if not names or (unknown := [name for name in names if name not in PROTOCOLS]):
            raise ValueError(f"expected protocols among {', '.join(PROTOCOLS)}, got {list(names and unknown)}")
        return names
