"""Configuration of the coarse avatar."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

from ahoy_core.avatar.deform import OffsetBounds
from ahoy_core.avatar.losses import LossWeights


class CoarseConfig(BaseModel):
    """What trades accuracy for time in `train_coarse`, and the terms of its objective."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    map_size: int = Field(default=256, ge=16, description="side of the canonical maps, a power of two: sets N")
    width: int = Field(default=16, ge=4, description="channels of the StyleUNet at its finest resolution")
    steps: int = Field(default=60, ge=1, description="optimiser steps")
    views_per_step: int = Field(default=2, ge=1, description="canonical views per network pass")
    frames_per_step: int = Field(default=3, ge=1, description="observed frames per network pass")
    max_frames: int = Field(default=48, ge=1, description="observed frames kept, evenly spread")
    learning_rate: float = Field(default=8e-3, gt=0)
    patch: int = Field(default=64, ge=32, description="side of the perceptual loss's patch, pixels")
    check_every: int = Field(default=25, ge=1, description="steps between two looks at the held-out frame")
    patience: int = Field(
        default=2, ge=1, description="checks in a row that may be worse than the best before it stops"
    )
    tolerance: float = Field(default=0.3, ge=0, description="dB by which a check must fall short to count as worse")
    seed: int = Field(default=0, ge=0)
    weights: LossWeights = LossWeights()
    bounds: OffsetBounds = OffsetBounds()
