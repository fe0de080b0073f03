"""Stage `complete`: the prior against the symmetric fill on hidden evidence; the winner completes the texture (3.1)."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict, Field

from ahoy_core.body.load import load_body
from ahoy_core.body.model import BodyModel
from ahoy_core.formats.images import contact_sheet, to_uint8, write_png
from ahoy_core.formats.npz import load_npz, save_npz
from ahoy_core.texture.atlas import ObservedAtlas
from ahoy_core.texture.canonical import canonical_views
from ahoy_core.texture.surface import Surface
from ahoy_core.texture.texels import texel_map
from ahoy_core.texture.texture import canonical_vertices
from tasks.prior_folder import no_prior, open_prior
from tasks.roles import ours, packaged_body
from tasks.stage import Role, Run, Stage, StageContext, StageOutput

SIDES = ("front", "left", "back", "right")


class CompleteConfig(BaseModel):
    """How much is hidden before a prior is believed, and whether the outcome decides."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    regions: int = Field(default=8, ge=1, description="observed regions hidden one after the other")
    believe: Literal["winner", "prior"] = Field(
        default="winner", description="prior: whatever the self-check says, for comparisons"
    )
    seed: int = Field(default=0, ge=0, description="of the regions and of the prior's noise")


def run_complete(config: CompleteConfig, ctx: StageContext) -> StageOutput:
    """Let the fills compete; with the symmetric fill the winner, the texture is handed on byte by byte."""
    from ahoy_core.prior.canonical import CanonicalFill, check_prior
    from ahoy_core.prior.selfcheck import BASELINE

    body, atlas = load_body(ctx.body), load_npz(ctx.inputs["texture"] / "atlas.npz")
    betas = load_npz(ctx.inputs["perceive"] / "body.npz", ["betas"])["betas"]
    observed = ObservedAtlas(atlas["observed_rgb"], atlas["coverage"], atlas["source_frame"])
    video = open_prior(ctx.prior, ctx.fills)
    told = json.loads((ctx.inputs["texture"] / "texture.json").read_text(encoding="utf-8"))
    fill = CanonicalFill(body, betas, observed, video.size, **told["filled_with"])
    check = check_prior(video, fill, config.regions, config.seed)
    winner = check.winner if config.believe == "winner" else _best_prior(video, check.errors)
    used = winner != BASELINE
    if used:
        _recolour(video, winner, config.seed, fill, atlas, (body, betas, observed), ctx)
    else:
        for name in ("atlas.npz", "canonical.npz"):
            shutil.copyfile(ctx.inputs["texture"] / name, ctx.out / name)
    found = {
        "winner": winner,
        "errors": check.errors,
        "confidence": check.errors.get(winner),
        "regions": check.regions,
        "hidden_pixels": check.pixels,
        "note": check.note,
        "prior_used": used,
        "light": told["light"],
    }
    (ctx.out / "complete.json").write_text(json.dumps(found, indent=1), encoding="utf-8")
    return StageOutput(_summary(found), ("completed.png",) if used else ())


def _best_prior(video: Any, errors: Mapping[str, float]) -> str:
    from ahoy_core.prior.canonical import ways

    return min(ways(video), key=lambda name: errors.get(name, 0.0))


def _recolour(
    video: Any,
    winner: str,
    seed: int,
    fill: Any,
    atlas: Mapping[str, np.ndarray],
    person: tuple[BodyModel, np.ndarray, ObservedAtlas],
    ctx: StageContext,
) -> None:
    from ahoy_core.prior.config import PriorConfig
    from ahoy_core.prior.recolour import recoloured_atlas
    from ahoy_core.prior.views import PriorBody

    body, betas, observed = person
    given = fill(torch.from_numpy(fill.observed))
    asked = PriorConfig(method=method_of(winner), seed=seed)
    made = PriorBody(video, given, fill.maps, fill.azimuth, asked).completed()
    surface, vertices = Surface.of(body), canonical_vertices(body, betas)
    texels = texel_map(surface, len(observed.coverage))
    filled = recoloured_atlas(observed, atlas["filled_rgb"], surface, texels, vertices, given, made)
    save_npz(ctx.out / "atlas.npz", {**atlas, "filled_rgb": filled}, compress=True)
    canonical = load_npz(ctx.inputs["texture"] / "canonical.npz")
    height, width = canonical["views"].shape[1:3]
    views = canonical_views(surface, texels, vertices, observed, filled, height, width)
    save_npz(ctx.out / "canonical.npz", {**canonical, "views": views.views}, compress=True)
    _draw(canonical["views"], views.views, ctx.out / "completed.png")


def completed(folder: Path) -> dict[str, Any]:
    """What this stage found, of its artifact."""
    found: dict[str, Any] = json.loads((folder / "complete.json").read_text(encoding="utf-8"))
    return found


def method_of(winner: str) -> Any:
    """The method of `PriorConfig` that a competitor of the self-check stands for; the clean-up for the baseline."""
    from ahoy_core.prior.canonical import METHODS

    return METHODS.get(winner, "clean-up")


def _draw(before: np.ndarray, after: np.ndarray, path: Path) -> None:
    pictures, labels = [], []
    for word, views in (("symmetric fill", before), ("prior", after)):
        alpha = views[..., 3:].astype(np.float32) / 255
        over_grey = torch.from_numpy(views[..., :3] / 255 * alpha + 0.5 * (1 - alpha)).permute(0, 3, 1, 2)
        pictures += [to_uint8(view) for view in over_grey]
        labels += [f"{side}, {word}" for side in SIDES]
    write_png(path, contact_sheet(pictures, labels, columns=4, cell=320))


def _summary(found: Mapping[str, Any]) -> dict[str, Any]:
    facts: dict[str, Any] = {f"colour error of {name}": f"{error:.3f}" for name, error in found["errors"].items()}
    facts["used"] = found["winner"]
    if found["confidence"] is not None:
        facts["confidence"] = f"colours that the video never shows are wrong by about {found['confidence']:.3f} of 1"
    notes = [found["note"]] if found["note"] else []
    return {"facts": facts, "notes": notes, **{k: found[k] for k in ("winner", "errors", "prior_used")}}


def obstacle(run: Run, summaries: Mapping[str, Mapping[str, Any]]) -> str:
    """Why this run cannot ask a prior."""
    return no_prior(run.prior, run.body, run.fills)


def lost(run: Run, summaries: Mapping[str, Mapping[str, Any]]) -> str:
    """Why a later stage need not ask the prior: on this video's own evidence the symmetric fill was closer."""
    if reason := no_prior(run.prior, run.body, run.fills):
        return reason
    found = summaries["complete"]
    if found["prior_used"]:
        return ""
    errors = ", ".join(f"{name} {error:.3f}" for name, error in found["errors"].items())
    return f"the prior did not win this video's self-check (colour errors: {errors or 'nothing could be hidden'})"


def _roles(config: CompleteConfig) -> Mapping[str, Role]:
    return {
        "body": packaged_body(),
        "video": ours("the run's prior"),
        "inpaint": ours("the prior, or the symmetric fill where it wins"),
    }


COMPLETE = Stage(
    "complete",
    8,
    CompleteConfig,
    ("perceive", "texture"),
    run_complete,
    _roles,
    obstacle=obstacle,
    fillable=("video",),
)
