"""What other systems need, in the paper's two settings: the first occluded frame, and our canonical image."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from ahoy_core.formats.images import write_png
from ahoy_core.formats.npz import load_npz

FIRST_FRAME, CANONICAL, ABOUT = "first_occluded_frame.png", "canonical_image.png", "inputs.json"
OCCLUDED_SHARE = 0.05  # of the body's silhouette that is not visible, for a frame to count as occluded


def first_occluded(occluded: np.ndarray, used: np.ndarray) -> int:
    """Row of the first usable frame in which the person is partly hidden; the most hidden one where none is.

    Args:
        occluded: [T] share of the body's silhouette that is not visible.
        used: [T] bool, a body was fitted.

    Raises:
        ValueError: no frame was fitted.
    """
    if not used.any():
        raise ValueError("expected a frame with a fitted body, got none; there is nothing to hand to another system")
    hidden = np.flatnonzero(used & (occluded >= OCCLUDED_SHARE))
    return int(hidden[0]) if len(hidden) else int(np.argmax(np.where(used, occluded, -1.0)))


def export_inputs(ingest: Path, perceive: Path, texture: Path, out: Path) -> list[Path]:
    """Write one capture's two pictures and what is known of them.

    Args:
        ingest: artifact folder of this stage.
        perceive: likewise.
        texture: likewise; that of `complete` where it ran.
        out: folder of the capture.

    Returns:
        Paths: the frame as RGBA whose alpha is the visible part of the person, the canonical front as RGBA, and JSON
        with the frame's number in the input, its camera, and the canonical camera.
    """
    video, masks = load_npz(ingest / "frames.npz"), load_npz(perceive / "masks.npz", ["visible", "occluded"])
    fit, canonical = load_npz(perceive / "body.npz", ["used", "K", "viewmat"]), load_npz(texture / "canonical.npz")
    row = first_occluded(masks["occluded"], fit["used"])
    out.mkdir(parents=True, exist_ok=True)
    write_png(out / FIRST_FRAME, np.concatenate([video["frames"][row], masks["visible"][row][..., None]], -1))
    write_png(out / CANONICAL, canonical["views"][0])
    about = {
        "first occluded frame": {
            "frame": int(video["index"][row]),
            "hidden share": round(float(masks["occluded"][row]), 4),
            "K": fit["K"].tolist(),
            "viewmat": fit["viewmat"].tolist(),
        },
        "canonical image": {
            "camera": "orthographic: u = fx * x_cam + cx, pixels a metre",
            "K": canonical["Ks"][0].tolist(),
            "viewmat": canonical["viewmats"][0].tolist(),
        },
    }
    (out / ABOUT).write_text(json.dumps(about, indent=1), encoding="utf-8")
    return [out / FIRST_FRAME, out / CANONICAL, out / ABOUT]
