"""Stage `texture`: frames and fitted body -> atlas, coverage, completed texture and canonical views (paper 3.1)."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ahoy_core.body.load import load_body
from ahoy_core.formats.images import contact_sheet, write_png
from ahoy_core.formats.npz import load_npz, save_npz
from ahoy_core.texture.by_roles import charts_on, complete_by, dense_by
from ahoy_core.texture.light import shading
from ahoy_core.texture.surface import Surface
from ahoy_core.texture.texture import Texture, TextureConfig, build_texture
from tasks.roles import ours, packaged_body
from tasks.stage import Role, Stage, StageContext, StageOutput

FILLABLE = ("surface", "inpaint", "views")
SHOWN = 5  # rejected frames named in the report
GREY = 128  # canonical views are shown over the grey that everything else is composited on


def run_texture(config: TextureConfig, ctx: StageContext) -> StageOutput:
    """Build the texture and the pictures of it."""
    frames = load_npz(ctx.inputs["ingest"] / "frames.npz", ["frames"])["frames"]
    masks = load_npz(ctx.inputs["perceive"] / "masks.npz", ["visible", "box"])
    fit = load_npz(ctx.inputs["perceive"] / "body.npz")
    body = load_body(ctx.body)
    dense = None
    if (role := ctx.fills.get("surface")) is not None:
        surface = Surface.of(body)
        dense = dense_by(role, surface, frames, masks["box"], fit["used"], charts_on(role, body, surface))

    def report(done: int, total: int) -> None:
        ctx.progress(done, total, "frames")

    texture = build_texture(frames, masks["visible"], fit, body, config, report, second=dense)
    if dense is not None and dense.charts is not None:
        moved = {str(t): round(pixels, 2) for t, pixels in sorted(dense.moved.items())}
        texture = replace(texture, notes={**texture.notes, "moved_by_charts_px": moved})
    texture = complete_by(texture, ctx.fills.get("inpaint"), ctx.fills.get("views"))
    save_npz(ctx.out / "atlas.npz", texture.atlas_arrays(), compress=True)
    save_npz(ctx.out / "canonical.npz", texture.canonical_arrays(), compress=True)
    (ctx.out / "texture.json").write_text(json.dumps(texture.notes, indent=1), encoding="utf-8")
    _pictures(texture, ctx)
    return StageOutput(_summary(texture, len(frames)), pictures=("atlas.png", "canonical.png"))


def _summary(texture: Texture, total: int) -> dict[str, Any]:
    """The readable part of the notes; all of them are in texture.json."""
    notes = texture.notes
    facts = {
        "seen in the video": f"{notes['observed_share']:.0%} of the surface",
        "copied from the other side": f"{notes['mirrored_share']:.0%}",
        "blended in": f"{notes['diffused_share']:.0%}",
        "fill": notes["fill"],
        "light": light_words(notes["light"]),
        "frames that wrote": f"{len(notes['frames_used'])} of {total}",
    }
    if (moved := notes.get("moved_by_charts_px")) is not None:
        mean = sum(moved.values()) / max(len(moved), 1)
        facts["moved to DensePose's charts"] = f"{len(moved)} frames, by {mean:.1f} pixels on average"
    rejected = [f"frame {frame} not used: {why}" for frame, why in list(notes["frames_rejected"].items())[:SHOWN]]
    more = len(notes["frames_rejected"]) - len(rejected)
    return {
        "facts": facts,
        "notes": [*rejected, *([f"and {more} more frames, see texture.json"] if more else [])],
        "observed_share": notes["observed_share"],
    }


def light_words(slope: Sequence[float]) -> str:
    """What a person reads of the estimated light.

    Args:
        slope: [3] of brightness over the normal of the canonical body: its left, its back, up.
    """
    if not any(slope):
        return "not estimated"
    axes, light = np.eye(3), np.asarray(slope)
    left, back, up = (shading(axes, light) / shading(-axes, light)).tolist()
    return f"back {back:.0%} as bright as front, left {left:.0%} as right, what faces up {up:.0%} as what faces down"


def _pictures(texture: Texture, ctx: StageContext) -> None:
    coverage = np.repeat((texture.coverage * 255).astype(np.uint8)[..., None], 3, -1)
    labels = ("observed", "coverage", "completed")
    sheet = contact_sheet([texture.observed_rgb, coverage, texture.filled_rgb], labels, columns=3, cell=512)
    write_png(ctx.out / "atlas.png", sheet)
    views = [_over_grey(view) for view in (texture.partial, *texture.views)]
    sheet = contact_sheet(views, ("observed only", "front", "left", "back", "right"), columns=5, cell=384)
    write_png(ctx.out / "canonical.png", sheet)


def _over_grey(rgba: np.ndarray) -> np.ndarray:
    alpha = rgba[..., 3:].astype(np.float32) / 255
    return (rgba[..., :3] * alpha + GREY * (1 - alpha)).round().astype(np.uint8)


def _roles(config: TextureConfig) -> Mapping[str, Role]:
    return {
        "body": packaged_body(),
        "surface": ours("ray-cast of the fitted body"),
        "inpaint": ours("symmetry and harmonic filling over the body's surface, part by part"),
        "views": ours("renders of the textured body"),
    }


TEXTURE = Stage("texture", 7, TextureConfig, ("ingest", "perceive"), run_texture, _roles, fillable=FILLABLE)
