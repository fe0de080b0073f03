"""What the texture stage is told: its knobs, its frames, and whether they can be used."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from ahoy_core.body.model import BodyModel
from ahoy_core.texture.atlas import WriteRule
from ahoy_core.texture.exposure import ExposureMatch
from ahoy_core.texture.fill import FillKind
from ahoy_core.texture.rays import BoolArray, FloatArray, IntArray


class TextureConfig(BaseModel):
    """Knobs of the texture stage.

    atlas_size: texels a side. frame_stride: every n-th used frame is looked at. rule: "first" (first write wins, the
    paper's), "best" (the best view of a texel wins) or "median" (the frame nearest to what most frames show wins).
    exposure: frames are brought to one exposure by a gain a channel, by gain and gamma, or not ("off"). grazing_cos and
    boundary_px: see `ahoy_core.texture.surface.look`. min_frame_confidence, min_joint_confidence: frames and body parts
    fitted worse than this write nothing. align_px: largest shift along each axis, in pixels of a body 200 pixels tall,
    by which a frame is moved to agree with what is written (0: off). outlier_levels: colours further (of 255, in any
    channel) from what most frames show of a texel are not written (0: all are). fill: symmetry and harmonic filling
    ("both"), or one of them alone ("symmetric", "harmonic"). light: fill with colours freed of the light they were seen
    in, and light them where they come to lie. drop_stains: what lies at the edge of what was seen and is unlike its
    garment (`ahoy_core.texture.stains`) counts as unseen. canonical_height, canonical_width: pixels of the canonical
    views. supersample: rays a pixel and axis in them.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    atlas_size: int = Field(512, ge=16, le=4096)
    frame_stride: int = Field(1, ge=1)
    rule: WriteRule = "median"
    exposure: ExposureMatch = "off"
    grazing_cos: float = Field(0.3, gt=0, lt=1)
    boundary_px: float = Field(2.0, ge=0)
    min_frame_confidence: float = Field(0.3, ge=0, le=1)
    min_joint_confidence: float = Field(0.0, ge=0, le=1)
    align_px: float = Field(4.0, ge=0, le=64)
    outlier_levels: float = Field(50.0, ge=0, le=255)
    fill: FillKind = "both"
    light: bool = True
    drop_stains: bool = True
    canonical_height: int = Field(512, ge=16, le=4096)
    canonical_width: int = Field(384, ge=16, le=4096)
    supersample: int = Field(2, ge=1, le=8)


def choose_frames(
    used: BoolArray, confidence: FloatArray, config: TextureConfig
) -> tuple[list[int], dict[str, list[int]]]:
    """Frames to look at, in order, and the others by reason.

    Args:
        used: [T] bool, a body was fitted.
        confidence: [T] in [0,1].
        config: stride and least confidence. Where no used frame reaches it, all used frames are taken: a doubtful
            picture of the person is better than none, and "below_min_confidence_but_taken" says so.
    """
    fitted = [int(t) for t in np.flatnonzero(used)]
    good = [t for t in fitted if confidence[t] >= config.min_frame_confidence]
    rejected = {"no_person": [int(t) for t in np.flatnonzero(~used)]}
    if good or not fitted:
        rejected["low_confidence"] = [t for t in fitted if t not in set(good)]
    else:
        rejected["below_min_confidence_but_taken"] = good = fitted
    chosen = good[:: config.frame_stride]
    rejected["stride"] = [t for t in good if t not in set(chosen)]
    return chosen, {reason: numbers for reason, numbers in rejected.items() if numbers}


def check_inputs(frames: IntArray, visible: IntArray, fit: Mapping[str, np.ndarray], body: BodyModel) -> None:
    """Refuse what `build_texture` cannot use.

    Raises:
        ValueError: naming the array, what was expected, and what came.
    """
    if frames.ndim != 4 or frames.shape[3] != 3 or frames.dtype != np.uint8:
        raise ValueError(
            f"expected frames [T,H,W,3] uint8, got {frames.shape} {frames.dtype}; decode with the ingest stage"
        )
    if visible.shape != frames.shape[:3] or visible.dtype != np.uint8:
        raise ValueError(f"expected visible masks {frames.shape[:3]} uint8, got {visible.shape} {visible.dtype}")
    count = len(frames)
    shapes = {
        "pose": (count, body.n_joints, 3),
        "transl": (count, 3),
        "betas": (body.n_betas,),
        "expression": (count, body.n_expressions),
        "joint_confidence": (count, body.n_joints),
        "frame_confidence": (count,),
        "used": (count,),
        "viewmat": (4, 4),
        "K": (3, 3),
    }
    for name, shape in shapes.items():
        if name not in fit:
            raise ValueError(f"expected the array {name!r} of the perceive stage's body.npz, got {sorted(fit)}")
        if fit[name].shape != shape:
            raise ValueError(f"expected {name} {shape} for these frames and this body, got {fit[name].shape}")
