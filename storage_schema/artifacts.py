"""What each stage leaves in the store: the files, and the arrays inside them.

A stage's artifact is a folder of files. `ARTIFACTS[stage]` names them; `check` (called at commit) opens every `.npz`
and compares its arrays with the declaration, so that a stage cannot publish something its readers do not expect.
Letters in a shape are sizes that must agree within one artifact (T frames, H x W pixels, J joints, ...).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Array:
    """One array of an `.npz` file: dtype name and shape, sizes given as integers or letters."""

    dtype: str
    shape: tuple[str | int, ...]


@dataclass(frozen=True)
class Blob:
    """One file of an artifact; `arrays` is empty for files that are not `.npz`."""

    name: str
    arrays: Mapping[str, Array] = field(default_factory=dict)
    optional: bool = False


_PERCEIVED: tuple[Blob, ...] = (
    Blob(
        "body.npz",
        {
            "pose": Array("float32", ("T", "J", 3)),  # axis-angle, radians; joint 0 is the root in the world
            "transl": Array("float32", ("T", 3)),  # metres, world
            "betas": Array("float32", ("S",)),  # one shape for the video
            "expression": Array("float32", ("T", "E")),
            "expression_confidence": Array("float32", ("T",)),
            "joint_confidence": Array("float32", ("T", "J")),  # [0,1]
            "frame_confidence": Array("float32", ("T",)),  # [0,1]
            "used": Array("bool", ("T",)),  # a person was found and fitted in this frame
            "viewmat": Array("float32", (4, 4)),
            "K": Array("float32", (3, 3)),
            "landmarks": Array("float32", ("T", 33, 3)),  # x, y in pixels, visibility in [0,1]
        },
    ),
    Blob(
        "masks.npz",
        {
            "visible": Array("uint8", ("T", "H", "W")),  # alpha of the visible part of the subject, 0..255
            "amodal": Array("uint8", ("T", "H", "W")),  # the whole person, hidden parts included
            "head": Array("uint8", ("T", "H", "W")),  # alpha of the visible head with its hair
            "occluded": Array("float32", ("T",)),  # share of the body's silhouette that is not visible
            "box": Array("float32", ("T", 4)),  # x0, y0, x1, y1 of the visible mask, pixels; zeros where unused
        },
    ),
    Blob("overlay.png"),  # body, landmarks and mask drawn on frames
    Blob("fit.json"),  # field of view and where it came from, final residuals, what was skipped and why
)
"""What is known of the subject in every frame."""

_ATLAS: Mapping[str, Array] = {
    "observed_rgb": Array("uint8", ("A", "A", 3)),  # first write wins; 0 where never seen
    "coverage": Array("float32", ("A", "A")),  # [0,1], 0 where never seen
    "source_frame": Array("int32", ("A", "A")),  # index into the ingested frames, -1 where never seen
    "filled_rgb": Array("uint8", ("A", "A", 3)),  # complete
    "chart": Array("bool", ("A", "A")),  # texel belongs to the body's surface
}

_CANONICAL: Mapping[str, Array] = {
    "views": Array("uint8", (4, "Hc", "Wc", 4)),  # RGBA, straight alpha: front, left, back, right
    "coverage": Array("uint8", (4, "Hc", "Wc")),  # observed share of each pixel, 0..255
    "partial": Array("uint8", ("Hc", "Wc", 4)),  # I_*^part: the front view, observed texels only
    "viewmats": Array("float32", (4, 4, 4)),
    "Ks": Array("float32", (4, 3, 3)),  # orthographic
}

ARTIFACTS: Mapping[str, tuple[Blob, ...]] = {
    "ingest": (
        Blob(
            "frames.npz",
            {
                "frames": Array("uint8", ("T", "H", "W", 3)),  # sRGB, display orientation
                "index": Array("int64", ("T",)),  # frame number in the source
                "pts": Array("float64", ("T",)),  # seconds from the start of the source
                "shot": Array("int32", ("T",)),  # shot number, from 0
            },
        ),
        Blob("probe.json"),
    ),
    "perceive": _PERCEIVED,
    "withhold": _PERCEIVED,  # the same, with frames that nothing may be learned from
    "truth": _PERCEIVED,  # the same, from a capture's truth, for sweeps of later stages
    "subjects": (
        Blob("subjects.png"),  # a row of pictures for each person
        Blob("subjects.json"),  # number, frames, shots, size of each; which are worth an avatar
    ),
    "texture": (
        Blob("atlas.npz", _ATLAS),
        Blob("canonical.npz", _CANONICAL),
        Blob("atlas.png"),  # observed, coverage, filled
        Blob("canonical.png"),  # the partial front and the four views
        Blob("texture.json"),
    ),
    "complete": (
        Blob("atlas.npz", _ATLAS),  # as the texture's, `filled_rgb` by whoever won
        Blob("canonical.npz", _CANONICAL),
        Blob("completed.png", optional=True),  # the symmetric fill above the prior's; none where the first won
        Blob("complete.json"),  # errors of all competitors on hidden regions, the winner
    ),
    "coarse": (
        Blob("avatar.safetensors"),
        Blob("avatar.json"),
        Blob("losses.parquet"),
        Blob("losses.png"),
        Blob("compare.png"),  # observed frames beside the avatar in their pose
    ),
    "identity": (
        Blob("pytorch_lora_weights.safetensors"),  # diffusers' LoRA format
        Blob("learned_embeds.safetensors"),  # the subject's word
        Blob("losses.parquet"),
        Blob("losses.png"),
        Blob("before_after.png"),  # seen, drawn before the fine-tuning, drawn after it
    ),
    "motions": (
        Blob(
            "motions.npz",
            {
                "map_pose": Array("float32", ("Q", "J", 3)),  # the configuration that a sequence's frames share
                "pose": Array("float32", ("Q", "T", "J", 3)),  # axis-angle, radians
                "transl": Array("float32", ("Q", "T", 3)),  # metres, world
                "viewmats": Array("float32", ("Q", "T", 4, 4)),
                "Ks": Array("float32", ("Q", "T", 3, 3)),  # pixels of the prior's person images
                "unseen": Array("float32", ("Q",)),  # share of the body that it shows and the video did not
            },
        ),
        Blob("motions.json"),  # names, kinds and reasons; what was left out, and why
    ),
    "hallucinate": (  # one artifact for each planned motion
        Blob(
            "sequence.npz",
            {
                "frames": Array("uint8", ("T", "H", "W", 3)),  # over grey, observed pixels pasted over
                "coverage": Array("uint8", ("T", "H", "W")),  # observed share, 0..255
                "alphas": Array("uint8", ("T", "H", "W")),
                "map_pose": Array("float32", ("J", 3)),
                "pose": Array("float32", ("T", "J", 3)),  # of the motion that rendered the coarse input
                "transl": Array("float32", ("T", 3)),
                "viewmats": Array("float32", ("T", 4, 4)),
                "Ks": Array("float32", ("T", 3, 3)),  # of the size in sequence.json, a multiple of the frames'
            },
        ),
        Blob("sequence.json"),
        Blob("before_after.png"),  # coarse renders above hallucinated frames
    ),
    "avatar": (
        Blob("avatar.safetensors"),
        Blob("avatar.json"),
        Blob("losses.parquet", optional=True),  # none where the coarse avatar is kept (ablation A)
        Blob("losses.png", optional=True),
        Blob("training.png", optional=True),  # targets above renders, as the training went
        Blob("faces.png", optional=True),  # the face views, blue where nothing counts; none without a head path
        Blob("compare.png"),
    ),
    "animate": (
        Blob("turntable.mp4"),
        Blob("motion.mp4"),
        Blob("avatar.ply"),
        Blob("turntable.png"),  # contact sheet: eight views
        Blob("animate.json"),
    ),
    "report": (Blob("report.html"),),
    "evaluate": (
        Blob("metrics.parquet"),  # a row per protocol, region, camera and frame
        Blob(
            "renders.npz",
            {
                "pixels": Array("uint8", ("P", 4)),  # RGB over grey 0.5 and alpha, picture after picture, row-major
                "sizes": Array("int32", ("N", 2)),  # height, width of each
            },
        ),
        Blob("cell.json"),  # which picture is which, and what was left out
    ),
}

_BESIDE = ("withhold", "truth", "subjects", "evaluate")
RUN_STAGES = tuple(stage for stage in ARTIFACTS if stage not in _BESIDE)
"""Stages that every video of a batch goes through, in order; the others belong to other commands."""
