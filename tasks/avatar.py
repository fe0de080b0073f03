"""Stage `avatar`: coarse avatar and supervision -> the full avatar (paper 3.3, equations 5-9)."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import platformdirs
import torch

from ahoy_core.avatar.avatar import Avatar, AvatarInfo
from ahoy_core.avatar.coarse_renders import coarse_sequences
from ahoy_core.avatar.files import load_avatar, save_avatar
from ahoy_core.avatar.full import FullResult, train_full
from ahoy_core.avatar.full_config import FullConfig
from ahoy_core.avatar.full_inputs import FullInputs
from ahoy_core.avatar.hallucinated import Supervision
from ahoy_core.avatar.supervision import CoarseInputs
from ahoy_core.body.canonical import canonical_pose
from ahoy_core.formats.images import contact_sheet, to_uint8, write_png
from ahoy_core.formats.npz import load_npz
from tasks.face_views import choose_faces, draw_faces
from tasks.hallucinate import read_supervision
from tasks.roles import ours, packaged_body, perceptual_network, perceptual_role
from tasks.stage import Role, Stage, StageContext, StageOutput
from tasks.training import compare, completed_texture, draw_training, held_out_rows, load_inputs, training_summary

PREVIEWS_SHOWN = 4
COARSE_MAP_POSES = 3  # of coarse renders: the canonical pose and two of the video's that are far from it
TERMS = ("total", "body", "observed", "head", "perceptual", "regularisers", "corrections")


def run_avatar(config: FullConfig, ctx: StageContext) -> StageOutput:
    """Train, save the avatar, and draw losses, pictures of the training and the comparison with the video."""
    coarse = load_avatar(ctx.inputs["coarse"])
    observed = load_inputs(ctx.inputs["ingest"], ctx.inputs["perceive"], completed_texture(ctx), ctx.body)
    if not config.switches.full:
        return _keep_coarse(coarse, observed, ctx)
    inputs, notes = _full_inputs(coarse, observed, config, ctx)
    previews: list[tuple[int, np.ndarray]] = []
    checkpoint = checkpoint_path(config, ctx)
    result = train_full(
        inputs,
        config,
        AvatarInfo(**coarse.info.model_dump()),
        lambda step, steps, loss: ctx.progress(step, steps, f"loss {loss:.4f}"),
        perceptual=perceptual_network(ctx.fills),
        preview=lambda step, picture: _show(previews, step, picture, ctx),
        checkpoint=checkpoint,
    )
    save_avatar(result.avatar, ctx.out)
    checkpoint.unlink(missing_ok=True)
    draw_training(result, TERMS, observed, ctx.out)
    pictures = ["compare.png", "training.png", "losses.png"]
    if inputs.faces is not None:
        draw_faces(inputs.faces, ctx.out / "faces.png")
        pictures.append("faces.png")
    return StageOutput(
        _summary(result, notes),
        tuple(pictures),
        metrics=held_out_rows(result.held_out, "full"),
    )


def checkpoint_path(config: FullConfig, ctx: StageContext) -> Path:
    """Where a killed run's successor looks: a file of this configuration and these inputs in the user's cache."""
    parts = [config.model_dump_json(), *(f"{name} {m.content_hash}" for name, m in sorted(ctx.manifests.items()))]
    name = hashlib.sha256("\n".join(parts).encode()).hexdigest()[:32]
    return Path(platformdirs.user_cache_dir("ahoy", appauthor=False)) / "checkpoints" / f"{name}.pt"


def _full_inputs(
    coarse: Avatar, observed: CoarseInputs, config: FullConfig, ctx: StageContext
) -> tuple[FullInputs, list[str]]:
    """What equation 9 asks for; the hallucinated sequences are coarse renders where no prior repainted them."""
    template = coarse.template
    with torch.no_grad():
        base = template.gather(coarse.network(template.maps()))
    expression = torch.from_numpy(load_npz(ctx.inputs["perceive"] / "body.npz", ["expression"])["expression"])
    faces = choose_faces(observed, template, expression, config, ctx)
    sequences, note = _sequences(coarse, observed, config, ctx)
    notes = [note, faces.note] if faces.note else [note]
    return FullInputs(observed, template, base, sequences, faces.views, faces.reason), notes


def _sequences(
    coarse: Avatar, observed: CoarseInputs, config: FullConfig, ctx: StageContext
) -> tuple[tuple[Supervision, ...], str]:
    if config.switches.supervise == "none":
        return (), "no sequences: switched off (B1)"
    if (made := _hallucinated(ctx)) and config.switches.supervise == "hallucinated":
        return made, f"supervised by {len(made)} hallucinated sequences: {', '.join(s.name for s in made)}"
    note = (
        "no prior has repainted the coarse renders (section 3.2): they supervise as they are, weighted by what the "
        "video never showed (ablation B2's data)"
    )
    return coarse_sequences(coarse, observed.body, _map_poses(observed)), note


def _hallucinated(ctx: StageContext) -> tuple[Supervision, ...]:
    return tuple(
        read_supervision(folder) for title, folder in sorted(ctx.inputs.items()) if title.startswith("hallucinate/")
    )


def _map_poses(observed: CoarseInputs) -> torch.Tensor:
    """The canonical pose, and fitted poses of the video that are far from it and from each other: [G,J,3]."""
    still = canonical_pose(observed.body)[None].float()
    pool = observed.pose[observed.used & torch.isfinite(observed.pose).flatten(1).all(1)].float()
    chosen = still
    while len(chosen) < COARSE_MAP_POSES and len(pool):
        away = torch.cdist(pool[:, 1:].flatten(1), chosen[:, 1:].flatten(1)).amin(1)
        chosen = torch.cat([chosen, pool[int(away.argmax())][None]])
    return chosen


def _keep_coarse(coarse: Avatar, observed: CoarseInputs, ctx: StageContext) -> StageOutput:
    save_avatar(coarse, ctx.out)
    compare(observed, coarse, ctx.out / "compare.png")
    note = "the coarse avatar is kept as it is: switched off (ablation A)"
    return StageOutput({"facts": {"gaussians": len(coarse)}, "notes": [note]}, ("compare.png",))


def _show(previews: list[tuple[int, np.ndarray]], step: int, picture: torch.Tensor, ctx: StageContext) -> None:
    """Keep a picture of the training, and put the latest ones where a person can see them."""
    previews.append((step, to_uint8(picture)))
    apart = max(1, len(previews) // PREVIEWS_SHOWN)
    chosen = [*previews[::apart][: PREVIEWS_SHOWN - 1], previews[-1]]
    sheet = contact_sheet([p for _, p in chosen], [f"step {n}" for n, _ in chosen], columns=2)
    write_png(ctx.out / "training.png", sheet)
    ctx.show(ctx.out / "training.png")


def _summary(result: FullResult, notes: list[str]) -> dict[str, Any]:
    summary = training_summary(result, "for the coarse avatar")
    reached = {f"largest {name} correction": f"{v:.0%} of its bound" for name, v in result.corrections.items()}
    return {**summary, "facts": {**summary["facts"], **reached}, "notes": [*notes, *summary["notes"]]}


def _roles(config: FullConfig) -> Mapping[str, Role]:
    return {"body": packaged_body(), "rasterizer": ours("ahoy_core.splat on the CPU"), **perceptual_role()}


AVATAR = Stage(
    "avatar",
    4,
    FullConfig,
    ("ingest", "perceive", "texture", "coarse"),
    run_avatar,
    _roles,
    wants=("complete", "hallucinate"),
    fillable=("perceptual", "face"),
)
