"""Configuration of the full avatar: one objective with named weights, and the switches of the ablation."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from ahoy_core.avatar.deform import OffsetBounds
from ahoy_core.avatar.losses import LossWeights

Supervise = Literal["hallucinated", "coarse", "none"]
FaceSource = Literal["observed", "reprojected", "both"]


class FullWeights(LossWeights):
    """lambda_body, lambda_obs, lambda_head, lambda_per and what lambda_reg stands for (equation 9).

    Terms that the coarse objective has too mean the same here; `canonical` and `filled` are not used.
    """

    body: float = Field(default=1.0, ge=0, description="hallucinated frames, head left out (equation 6)")
    observed: float = Field(default=1.0, ge=0, description="observed frames")
    head: float = Field(default=0.5, ge=0, description="face views (equation 8)")
    covered: float = Field(
        default=0.05, ge=0, le=1, description="weight of a hallucinated pixel whose surface the video showed; else 1"
    )
    outside: float = Field(default=1.0, ge=0, le=1, description="a hallucinated pixel beside the person")
    color_change: float = Field(default=0.15, ge=0, description="squared difference of colour offsets of neighbours")
    pose_change: float = Field(
        default=0.003, ge=0, description="squared pose-dependent part of the offsets: what poses share is not in it"
    )
    pose_prior: float = Field(default=2e-3, ge=0, description="squared pose corrections over their expected size")
    camera_prior: float = Field(default=8e-3, ge=0, description="squared camera corrections over their expected size")
    tone_prior: float = Field(default=2e-3, ge=0, description="squared tone corrections over their expected size")


class Switches(BaseModel):
    """The ablation's switches: each turns one thing off; all on is the full method."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    full: bool = Field(default=True, description="off: the coarse avatar as it is (A)")
    supervise: Supervise = Field(
        default="hallucinated", description="none: no hallucinated videos (B1); coarse: coarse renders instead (B2)"
    )
    pose_maps: bool = Field(default=True, description="off: one map for all poses (C1)")
    corrections: bool = Field(default=True, description="off: no pose, camera and tone corrections (C2)")
    shared_map_pose: bool = Field(default=True, description="off: map pose = each frame's LBS pose (C3)")
    head_split: bool = Field(default=True, description="off: hallucinated heads supervise, no face views (D)")


ABLATIONS: Mapping[str, Switches] = MappingProxyType(
    {
        "full": Switches(),
        "A": Switches(full=False),
        "B1": Switches(supervise="none"),
        "B2": Switches(supervise="coarse"),
        "C1": Switches(pose_maps=False),
        "C2": Switches(corrections=False),
        "C": Switches(pose_maps=False, corrections=False),
        "C3": Switches(shared_map_pose=False),
        "D": Switches(head_split=False),
    }
)
"""Rows of the paper's ablation (and finer ones) as switches."""


class CorrectionBounds(BaseModel):
    """Largest corrections of a frame, each `bound * tanh(raw)`, and the sizes that their priors expect."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    pose: float = Field(default=0.3, gt=0, description="radians, per axis of a joint")
    turn: float = Field(default=0.05, gt=0, description="radians, per axis of the camera")
    shift: float = Field(default=0.15, gt=0, description="metres, per axis of the camera")
    gain: float = Field(default=0.4, gt=0, description="logarithm of a colour channel's gain")
    bias: float = Field(default=0.15, gt=0, description="sRGB, of a colour channel")
    expected: float = Field(default=0.2, gt=0, le=1, description="expected size of each, as a share of its bound")
    registered: float = Field(
        default=0.05,
        gt=0,
        le=1,
        description="the same for sequences that were rendered where they say: half a pixel of the prior's pictures",
    )


class FullConfig(BaseModel):
    """What trades accuracy for time in `train_full`, and the terms of its objective."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    map_reduction: int = Field(default=2, ge=1, description="side of the template's maps over that of the pose maps")
    width: int = Field(default=16, ge=4, description="channels of the StyleUNet at its finest resolution")
    steps: int = Field(default=120, ge=1, description="optimiser steps")
    sequences_per_step: int = Field(default=2, ge=1, description="hallucinated sequences, one network pass each")
    shots_per_sequence: int = Field(default=3, ge=1, description="frames of each")
    frames_per_step: int = Field(default=2, ge=1, description="observed frames, of one map pose")
    face_views: FaceSource = Field(
        default="observed",
        description="observed: frames that show the face; reprojected: the head's own texture from all sides",
    )
    faces_per_step: int = Field(default=2, ge=1, description="face views")
    max_frames: int = Field(default=48, ge=1, description="observed frames kept, evenly spread")
    observed_map_poses: int = Field(default=4, ge=1, description="map poses that the observed frames share")
    patch: int = Field(default=64, ge=32, description="side of the perceptual loss's patch, pixels")
    learning_rate: float = Field(default=4e-3, gt=0, description="of the network")
    base_rate: float = Field(default=2e-2, gt=0, description="of the offsets that all poses share")
    correction_rate: float = Field(default=2e-2, gt=0, description="of pose, camera and tone corrections")
    warm_up: float = Field(default=0.05, ge=0, lt=1, description="share of the steps in which rates rise")
    correct_from: float = Field(default=0.1, ge=0, le=1, description="share of the steps before corrections move")
    clip_norm: float = Field(default=1.0, gt=0, description="largest norm of each parameter group's gradient")
    ema: float = Field(default=0.95, ge=0, lt=1, description="decay of the moving average that is kept")
    check_every: int = Field(default=25, ge=1, description="steps between looks at the held-out frame, and checkpoints")
    patience: int = Field(default=3, ge=1, description="checks in a row that may be worse than the best")
    tolerance: float = Field(default=0.3, ge=0, description="dB by which a check must fall short to count as worse")
    pose_components: int = Field(default=16, ge=0, description="axes of the training poses that animation keeps to")
    pose_strength: float = Field(default=1.0, ge=0, le=1, description="how far a driving pose's map is pulled to them")
    seed: int = Field(default=0, ge=0)
    switches: Switches = Switches()
    weights: FullWeights = FullWeights()
    bounds: OffsetBounds = OffsetBounds()
    corrections: CorrectionBounds = CorrectionBounds()
