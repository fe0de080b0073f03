"""Stage `perceive`: frames -> fitted body, camera, confidence and the mask of the visible person (paper 3.1)."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from ahoy_core.body.load import load_body
from ahoy_core.formats.images import write_png
from ahoy_core.formats.npz import load_npz, save_npz
from ahoy_core.perceive.filled import Filled
from ahoy_core.perceive.networks import files_of
from ahoy_core.perceive.overlay import contact_sheet
from ahoy_core.perceive.perceive import PerceiveConfig, Perception, perceive
from tasks.roles import landmark_networks, networks, ours, packaged, packaged_body
from tasks.stage import Role, Stage, StageContext, StageOutput

FILLABLE = ("pose", "mask", "head")
MASKS = ("visible", "amodal", "head", "occluded", "box")


def run_perceive(config: PerceiveConfig, ctx: StageContext) -> StageOutput:
    """Perceive, and draw what was perceived on the frames."""
    video = load_npz(ctx.inputs["ingest"] / "frames.npz")
    body = load_body(ctx.body)
    nets = landmark_networks(config.model, torch.get_num_threads())
    K, viewmat = _camera(config, video["frames"].shape[2])
    filled = Filled(*(ctx.fills.get(role) for role in FILLABLE))
    clip = video["frames"], video["pts"], video["shot"]
    found = perceive(*clip, K, body, nets, config, ctx.progress, viewmat=viewmat, filled=filled)
    arrays = {f.name: getattr(found, f.name) for f in dataclasses.fields(found) if f.name != "notes"}
    save_npz(ctx.out / "masks.npz", {name: arrays.pop(name) for name in MASKS}, compress=True)
    save_npz(ctx.out / "body.npz", arrays)
    (ctx.out / "fit.json").write_text(json.dumps(found.notes, indent=1), encoding="utf-8")
    write_png(ctx.out / "overlay.png", contact_sheet(video["frames"], found, body))
    return StageOutput(_summary(found), ("overlay.png",), frames=_rows(found, video))


def _camera(config: PerceiveConfig, width: int) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Intrinsics for frames of `width` pixels, and where the camera stands, as far as they are known."""
    if config.camera is None:
        return None, None
    K = np.array(config.camera.K, dtype=np.float64).reshape(3, 3)
    K[:2] *= width / config.camera.width
    stands = config.camera.viewmat
    return K, None if stands is None else np.array(stands, dtype=np.float64).reshape(4, 4)


def _summary(found: Perception) -> dict[str, Any]:
    notes = found.notes
    facts = {
        "people": notes["people"],
        "frames with the subject": f"{notes['frames_used']} of {notes['frames']}",
        "hidden share of the body": f"{notes['occluded_mean']:.0%} on average",
        "camera": f"{notes['fov_degrees']} degrees diagonal, {notes['fov_from']}",
        "faces read": f"in {notes['faces_read']} frames",
        "mean confidence": f"{found.frame_confidence[found.used].mean():.2f}",
    }
    gaps = ", ".join(f"{a}-{b}" if b > a else str(a) for a, b in notes["frames_without_person"])
    without = [f"no person in frames {gaps}; their poses are interpolated and they are not used"] if gaps else []
    return {"facts": facts, "notes": [*without, *(f"{k}: {why}" for k, why in notes["skipped"].items())]}


def _rows(found: Perception, video: Mapping[str, np.ndarray]) -> list[dict[str, Any]]:
    return [
        {
            "frame": t,
            "index": int(video["index"][t]),
            "pts": float(video["pts"][t]),
            "used": bool(found.used[t]),
            "confidence": float(found.frame_confidence[t]),
            "pose": found.pose[t],
            "transl": found.transl[t],
            "K": found.K,
            "viewmat": found.viewmat,
            "box": found.box[t],
        }
        for t in range(len(found.used))
    ]


def _roles(config: PerceiveConfig) -> Mapping[str, Role]:
    seen_by = networks(files_of(config.model))
    learned = {"corrector": packaged("corrector.safetensors"), "face map": packaged("face.safetensors")}
    return {"body": packaged_body(), "pose": seen_by, "mask": seen_by, "head": ours("body's head region"), **learned}


PERCEIVE = Stage("perceive", 8, PerceiveConfig, ("ingest",), run_perceive, _roles, fillable=FILLABLE)
