"""Stage `evaluate`: one configuration on one capture, every picture rendered, kept and scored (paper section 4)."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch

from ahoy_core.avatar.files import load_avatar
from ahoy_core.body.load import load_body
from ahoy_core.captures.capture import Capture
from ahoy_core.formats.images import to_uint8
from ahoy_core.formats.npz import save_npz
from ahoy_core.metrics.protocol import PROTOCOLS
from ahoy_core.metrics.score import Made, score_picture
from tasks.evaluation.config import EvaluateConfig
from tasks.evaluation.fitted import Fitted
from tasks.evaluation.renderers import AvatarRenderer, Renderer, reference
from tasks.evaluation.truths import Shot, Truths
from tasks.roles import packaged_body, perceptual_network, perceptual_role
from tasks.stage import Role, Stage, StageContext, StageOutput

VERSION = 2
COLUMNS = (
    *("capture", "config", "protocol", "region", "camera", "frame"),
    *("psnr", "ssim", "perceptual", "perceptual_name", "iou", "protocol_id", "input_setting"),
)

MakeRenderer = Callable[[StageContext, Capture, Fitted], Renderer]


def evaluate_stage(capture: Capture, every: int | None, needs: tuple[str, ...], make: MakeRenderer) -> Stage:
    """The stage for one capture.

    Args:
        capture: whose truth; the input `capture` stands for its contents in the key.
        every: how many frames apart those are that were withheld; None where none were.
        needs: inputs of the renderer beside capture, ingest and perceive.
        make: who makes the pictures.
    """

    def run(config: EvaluateConfig, ctx: StageContext) -> StageOutput:
        fitted = Fitted.read(ctx.inputs["ingest"], ctx.inputs["perceive"])
        return _run(config, ctx, Truths(capture, fitted, config.size, every), make(ctx, capture, fitted))

    inputs = ("capture", "ingest", "perceive", *needs)
    return Stage("evaluate", VERSION, EvaluateConfig, inputs, run, _roles, fillable=("perceptual",))


def avatar_renderer(ctx: StageContext, capture: Capture, fitted: Fitted) -> Renderer:
    """The avatar among the stage's inputs."""
    return AvatarRenderer(load_avatar(ctx.inputs["avatar"]), load_body(ctx.body), capture, fitted)


def reference_renderer(name: str) -> MakeRenderer:
    """A reference row by name."""
    return lambda ctx, capture, fitted: reference(name)


def _run(config: EvaluateConfig, ctx: StageContext, truths: Truths, renderer: Renderer) -> StageOutput:
    network = perceptual_network(ctx.fills)
    shots, notes = _shots(config, truths)
    rows: list[dict[str, Any]] = []
    kept: list[tuple[Shot, np.ndarray]] = []
    for number, shot in enumerate(shots):
        ctx.progress(number, len(shots), shot.protocol)
        made = renderer(shot)
        if made is None:
            notes.append(f"{shot.protocol}, {shot.view.camera}, frame {shot.view.frame}: no picture was given")
            continue
        made, stored = as_stored(made)
        kept.append((shot, stored))
        protocol = PROTOCOLS[shot.protocol]
        for score in score_picture(made, shot.truth, protocol.pixels, network):
            rows.append(_row(config, shot, dataclasses.asdict(score), network.name if network else None))
    _write(ctx.out, rows, kept, notes)
    facts = {"pictures": len(kept), "rows": len(rows)}
    return StageOutput({"facts": facts, "notes": notes}, metrics=rows)


def _shots(config: EvaluateConfig, truths: Truths) -> tuple[list[Shot], list[str]]:
    shots: list[Shot] = []
    notes = list(truths.capture.notes)
    for protocol in config.protocols:
        views, reason = truths.views(protocol)
        found = [shot for view in views if (shot := truths.shot(protocol, view)) is not None]
        if not found:
            notes.append(f"{protocol} left out: {reason if not views else 'the true masks show nobody'}")
        elif len(found) < len(views):
            notes.append(f"{protocol}: {len(views) - len(found)} of {len(views)} true pictures show nobody")
        shots += found
    return shots, notes


def as_stored(made: Made) -> tuple[Made, np.ndarray]:
    """The picture as an 8-bit file would have it, which is what is scored, and its pixels [H,W,4] uint8.

    Alpha is 0 throughout where a system gives none; it is then not scored either.

    Raises:
        ValueError: a value is not finite: a broken picture must not be scored as a dark one.
    """
    if not bool(torch.isfinite(made.rgb).all()):
        raise ValueError("expected a finite picture, got NaN or infinity; the avatar is broken, look at its training")
    alpha = torch.zeros(made.rgb.shape[1:]) if made.alpha is None else made.alpha
    rgb8, alpha8 = to_uint8(made.rgb), to_uint8(alpha.expand(3, -1, -1))[..., :1]
    stored = np.concatenate([rgb8, alpha8], -1)
    rgb = torch.from_numpy(rgb8).permute(2, 0, 1).float() / 255
    seen = None if made.alpha is None else torch.from_numpy(alpha8[..., 0]).float() / 255
    return Made(rgb, seen), stored


def _row(config: EvaluateConfig, shot: Shot, score: Mapping[str, Any], network: str | None) -> dict[str, Any]:
    height, width = shot.truth.alpha.shape
    perceptual = f"{network}, input [0,1]" if network else ""
    protocol = PROTOCOLS[shot.protocol].model_copy(
        update={"region": score["region"], "perceptual": perceptual, "input": config.input}
    )
    return {
        "capture": config.capture,
        "config": config.config,
        "protocol": shot.protocol,
        "camera": shot.view.camera,
        "frame": shot.view.frame,
        "perceptual_name": network if score["perceptual"] is not None else None,
        "protocol_id": protocol.id(height, width),
        "input_setting": config.input_setting,
        **score,
    }


def _write(out: Path, rows: list[dict[str, Any]], kept: list[tuple[Shot, np.ndarray]], notes: list[str]) -> None:
    pq.write_table(to_table(rows), out / "metrics.parquet")
    pixels = np.concatenate([stored.reshape(-1, 4) for _, stored in kept] or [np.zeros((0, 4), np.uint8)])
    sizes = np.array([stored.shape[:2] for _, stored in kept], dtype=np.int32).reshape(-1, 2)
    save_npz(out / "renders.npz", {"pixels": pixels, "sizes": sizes}, compress=True)
    pictures = [{"protocol": shot.protocol, **dataclasses.asdict(shot.view)} for shot, _ in kept]
    (out / "cell.json").write_text(json.dumps({"pictures": pictures, "notes": notes}, indent=1), encoding="utf-8")


def to_table(rows: Sequence[Mapping[str, Any]]) -> pa.Table:
    """Rows as a table with fixed columns, also without any row."""
    real, text = pa.float64(), pa.string()
    kinds = {"frame": pa.int32(), **dict.fromkeys(("psnr", "ssim", "perceptual", "iou"), real)}
    schema = pa.schema([pa.field(name, kinds.get(name, text)) for name in COLUMNS])
    return pa.Table.from_pylist([dict(row) for row in rows], schema=schema)


def _roles(config: EvaluateConfig) -> Mapping[str, Role]:
    return {"body": packaged_body(), **perceptual_role()}
