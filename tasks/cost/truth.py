"""Stage `truth`: a capture's true bodies and masks in the form of perceive's artifact.

Later stages are swept on it, so that what a knob of theirs buys is not drowned in the errors of the fit.
"""

from __future__ import annotations

import json

import numpy as np
import torch

from ahoy_core.body.packaged import PackagedBody, load_packaged_body
from ahoy_core.captures.capture import Capture
from ahoy_core.captures.fit import Fit, posed_vertices, read_clip, true_fit
from ahoy_core.formats.images import write_png
from ahoy_core.formats.npz import load_npz, save_npz
from ahoy_core.metrics.regions import mask_box
from ahoy_core.texture.rays import Caster, hit_map, to_camera
from tasks.stage import NoKnobs, Stage, StageContext, StageOutput

LANDMARKS = 33


def truth_stage(capture: Capture) -> Stage:
    """The stage for one capture; the input `capture` stands for its contents in the key.

    Raises (when run):
        ValueError: the capture has no true masks of every frame.
    """

    def run(config: NoKnobs, ctx: StageContext) -> StageOutput:
        video = load_npz(ctx.inputs["ingest"] / "frames.npz", ["frames", "index"])
        write_truth(capture, load_packaged_body(), video, ctx)
        return StageOutput({"facts": {"frames": len(video["index"])}})

    return Stage("truth", 1, NoKnobs, ("capture", "ingest"), run)


def write_truth(capture: Capture, body: PackagedBody, video: dict[str, np.ndarray], ctx: StageContext) -> None:
    """Write the files for the frames that ingest kept, at their size."""
    index = video["index"]
    height, width = video["frames"].shape[1:3]
    clip, fit = read_clip(capture), dict(true_fit(capture, body))
    if clip.frames.shape[1:3] != (height, width):
        raise ValueError(
            f"expected frames of the capture's own size {clip.frames.shape[1:3]}, got {(height, width)}; sweeps on "
            "true bodies leave ingest.max_size at or above it"
        )
    for name in ("pose", "transl", "expression", "joint_confidence", "frame_confidence", "used"):
        fit[name] = fit[name][index]
    visible = clip.visible[index]
    hits = [_body_hits(body, fit, t, width, height) for t in range(len(index))]
    on_head = body.face_regions["head"].numpy()
    amodal = np.stack([hit >= 0 for hit in hits])
    head = np.stack([(hit >= 0) & on_head[hit] for hit in hits])
    seen = visible > 127
    masks = {
        "visible": visible,
        "amodal": np.where(amodal, np.uint8(255), np.uint8(0)),
        "head": np.where(head & seen, visible, np.uint8(0)),
        "occluded": np.array([1 - (a & s).sum() / max(a.sum(), 1) for a, s in zip(amodal, seen, strict=True)], "f4"),
        "box": np.array([_box(mask) for mask in visible], dtype=np.float32),
    }
    extra = {
        "expression_confidence": np.zeros(len(index), np.float32),
        "landmarks": np.zeros((len(index), LANDMARKS, 3), np.float32),
    }
    save_npz(ctx.out / "body.npz", {name: np.asarray(value) for name, value in {**fit, **extra}.items()})
    save_npz(ctx.out / "masks.npz", masks, compress=True)
    (ctx.out / "fit.json").write_text(json.dumps({"from": "the capture's truth"}), encoding="utf-8")
    write_png(ctx.out / "overlay.png", video["frames"][0])


def _body_hits(body: PackagedBody, fit: Fit, frame: int, width: int, height: int) -> np.ndarray:
    """Triangle [H,W] of the body before each pixel of the input's camera, -1 for none."""
    points = to_camera(posed_vertices(body, fit, frame), fit["viewmat"])
    return hit_map(Caster(points, body.faces.numpy().astype(np.int32)), fit["K"], width, height).face


def _box(mask: np.ndarray) -> tuple[float, ...]:
    alpha = torch.from_numpy(mask).float() / 255
    return mask_box(alpha) if bool((alpha > 0.01).any()) else (0.0, 0.0, 0.0, 0.0)
