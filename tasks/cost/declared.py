"""What `ahoy cost` sweeps: a declaration a stage, with its knobs, their values, and what errors are counted against.

Values are ordered from cheap to dear. Each knob is swept alone, the others as the base settings say.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, get_args

from ahoy_core.captures.capture import Capture
from ahoy_core.perceive.networks import Landmarker
from tasks.avatar import AVATAR, checkpoint_path
from tasks.coarse import COARSE
from tasks.cost.errors import FolderErrors, perceived, rendered, textured
from tasks.evaluation.inputs import known_camera
from tasks.perceive import PERCEIVE
from tasks.settings import Preset
from tasks.stage import Stage, StageContext
from tasks.texture import TEXTURE

END_TO_END = "end-to-end"


@dataclass(frozen=True)
class StageSweep:
    """How the cost of one stage is measured.

    Attributes:
        stage: which.
        knobs: knob -> values.
        errors: of an output folder, against the capture's truth.
        drawn: name and unit of the error that is drawn, and that the Pareto set is of.
        reference: what it is compared with, in words.
        true_bodies: the inputs are made from the capture's true bodies and masks instead of what perception found.
        knows: knobs that every setting gets from the capture.
        warm_up: knobs of a short run before the first that counts.
        forget: removes what an interrupted run left for its successor, which would make that one look cheap.
    """

    stage: Stage
    knobs: Mapping[str, Sequence[Any]]
    errors: FolderErrors
    drawn: tuple[str, str]
    reference: str
    true_bodies: bool = True
    knows: Callable[[Capture], Mapping[str, Any]] = lambda capture: {}
    warm_up: Mapping[str, Any] = field(default_factory=dict)
    forget: Callable[[Any, StageContext], None] = lambda config, ctx: None


STAGE_SWEEPS: Mapping[str, StageSweep] = {
    "perceive": StageSweep(
        PERCEIVE,
        {
            "model": get_args(Landmarker),
            "passes": (1, 2, 4),
            "iterations": (1, 3, 10, 30),
            "stride": (4, 2, 1),
            "outline": (0.0, 1.0),
            "corrector": (False, True),
            "mask_refinement": (False, True),
        },
        perceived,
        ("pa_mpjpe_mm", "mm"),
        "the true body and the true masks",
        true_bodies=False,
        knows=lambda capture: {"camera": known_camera(capture)},
        warm_up={"stride": 24, "iterations": 1},
    ),
    "texture": StageSweep(
        TEXTURE,
        {
            "atlas_size": (128, 256, 512, 1024),
            "frame_stride": (16, 8, 4, 2, 1),
            "rule": ("first", "best", "median"),
            "fill": ("symmetric", "harmonic", "both"),
            "align_px": (0.0, 4.0),
            "light": (False, True),
        },
        textured,
        ("texel_l1", "levels of 255"),
        "the true pictures, looked up through the true body; the fit and the masks are the true ones",
        warm_up={"atlas_size": 64, "frame_stride": 24, "canonical_height": 64, "canonical_width": 48},
    ),
    "coarse": StageSweep(
        COARSE,
        {"steps": (15, 30, 60, 100, 200), "map_size": (64, 128, 256), "width": (8, 16), "frames_per_step": (1, 3)},
        rendered,
        ("rmse", "levels of 255"),
        "the true pictures of all cameras, driven by the true body; the fit and the masks are the true ones",
        warm_up={"steps": 1, "map_size": 32},
    ),
    "avatar": StageSweep(
        AVATAR,
        {"steps": (15, 30, 60, 120, 240), "map_reduction": (4, 2, 1), "width": (8, 16), "shots_per_sequence": (1, 3)},
        rendered,
        ("rmse", "levels of 255"),
        "the true pictures of all cameras, driven by the true body; the fit and the masks are the true ones",
        warm_up={"steps": 1},
        forget=lambda config, ctx: checkpoint_path(config, ctx).unlink(missing_ok=True),
    ),
}

END_TO_END_KNOBS: Mapping[Preset, Mapping[str, Sequence[Any]]] = {
    "draft": {
        "ingest.max_size": (192, 384),
        "ingest.max_frames": (16, 48),
        "perceive.passes": (1, 2, 4),
        "perceive.iterations": (3, 10, 30),
        "texture.atlas_size": (128, 256, 512),
        "texture.frame_stride": (4, 2, 1),
        "texture.light": (False, True),
        "texture.drop_stains": (False, True),
        "coarse.map_size": (64, 128, 256),
        "coarse.steps": (30, 60, 100, 200),
        "avatar.steps": (15, 30, 60, 120, 240),
        "animate.turntable_frames": (36, 72),
    },
    "standard": {
        "perceive.passes": (2, 4),
        "coarse.map_size": (128, 256),
        "coarse.steps": (30, 60, 100),
        "avatar.steps": (30, 60, 120),
    },
}
"""Swept one at a time over the whole run, from the video to the report, round these presets: what a knob gains beside
draft's others says little of what it gains beside standard's (maps of 256 are worth their time there alone)."""

END_TO_END_REFERENCE = (
    "the true pictures of the other cameras at the input's moments and in the unseen motion, driven by the true body "
    "(means of `novel-view-gt` and `novel-pose-gt`, box of the person); the method is told the camera and nothing else "
    "that is true"
)

NOT_SWEPT: Mapping[str, str] = {
    "ingest": "its knobs say what later stages see: swept end to end",
    "complete": "what it chooses between is measured by benchmarks.prior: docs/prior.md",
    "identity": "rank and steps are measured by benchmarks.prior: docs/prior.md",
    "motions": "a plan, made in under a second",
    "hallucinate": "solvers and evaluations are measured by benchmarks.prior: docs/prior.md",
    "animate": "its knobs change size and length of the videos, not how right they are; effects: docs/render.md",
    "report": "no knobs",
}
"""Stages without a sweep of their own, and why."""
