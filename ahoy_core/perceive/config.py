"""Knobs of the stage perceive."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from ahoy_core.perceive.networks import FULL, Landmarker


class KnownCamera(BaseModel):
    """The still camera that took the video, where it is known.

    Attributes:
        K: [9] row-major intrinsics, in pixels of pictures of `width`.
        viewmat: [16] row-major, world -> camera, from a world with z up and the floor at z = 0; None if not known.
        width: pixels.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    K: tuple[float, ...] = Field(min_length=9, max_length=9)
    viewmat: tuple[float, ...] | None = Field(default=None, min_length=16, max_length=16)
    width: int = Field(ge=1)


class PerceiveConfig(BaseModel):
    """Knobs of the stage.

    Attributes:
        model: the landmark network that fills the roles pose and mask; all but the full one are optional downloads
            (`ahoy models pull pose_landmark_heavy`).
        passes: readings averaged per frame: 1 forward, 2 also mirrored, 3 also backward in time, 4 backward mirrored
            too.
        stride: look at every stride-th frame; the others get poses in between and count as unused.
        subject: number of the person, 0 or None the most prominent.
        iterations: most steps in each of the fit's stages; it stops earlier when nothing is gained.
        smoothing: weight of accelerations in the fit.
        fov_degrees: diagonal field of view assumed where no camera is given.
        outline: weight of the masks' outlines in the fit; 0: landmarks alone.
        mask_refinement: move the mask's edges to the picture's, and hold it down where a still camera shows no change.
        camera: the camera that took the video; None assumes `fov_degrees`.
        corrector: let the packaged network correct the landmarks and say how far each can be trusted.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    model: Landmarker = FULL
    passes: Literal[1, 2, 3, 4] = 2
    stride: int = Field(default=1, ge=1, le=100)
    subject: int | None = Field(default=None, ge=0)
    iterations: int = Field(default=10, ge=1, le=1000)
    smoothing: float = Field(default=1.0, ge=0.0, le=1000.0)
    fov_degrees: float = Field(default=50.0, gt=5.0, lt=150.0)
    outline: float = Field(default=1.0, ge=0.0, le=1000.0)
    camera: KnownCamera | None = None
    corrector: bool = True
    mask_refinement: bool = True
