"""Stage `coarse`: canonical views and observed frames -> the coarse avatar (paper 3.1, equation 1)."""

from __future__ import annotations

from collections.abc import Mapping

from ahoy_core.avatar.avatar import AvatarInfo
from ahoy_core.avatar.coarse import train_coarse
from ahoy_core.avatar.config import CoarseConfig
from ahoy_core.avatar.files import save_avatar
from tasks.roles import body_role, ours, packaged_body, perceptual_network, perceptual_role
from tasks.stage import Role, Stage, StageContext, StageOutput
from tasks.training import completed_texture, draw_training, held_out_rows, load_inputs, training_summary

TERMS = ("total", "canonical", "observed", "regularisers", "perceptual")


def run_coarse(config: CoarseConfig, ctx: StageContext) -> StageOutput:
    """Train, save the avatar, and draw the loss and the comparison with the video."""
    inputs = load_inputs(ctx.inputs["ingest"], ctx.inputs["perceive"], completed_texture(ctx), ctx.body)
    source = ctx.manifests["ingest"].inputs["source"]
    info = AvatarInfo(
        body=inputs.body.name, body_sha256=body_role(ctx.body).weights_sha256, provenance={"source_sha256": source}
    )
    result = train_coarse(
        inputs,
        config,
        info,
        lambda step, steps, loss: ctx.progress(step, steps, f"loss {loss:.4f}"),
        perceptual=perceptual_network(ctx.fills),
    )
    save_avatar(result.avatar, ctx.out)
    draw_training(result, TERMS, inputs, ctx.out)
    return StageOutput(
        training_summary(result, "before training"),
        ("compare.png", "losses.png"),
        metrics=held_out_rows(result.held_out, "coarse", "textured template"),
    )


def _roles(config: CoarseConfig) -> Mapping[str, Role]:
    return {"body": packaged_body(), "rasterizer": ours("ahoy_core.splat on the CPU"), **perceptual_role()}


COARSE = Stage(
    "coarse",
    3,
    CoarseConfig,
    ("ingest", "perceive", "texture"),
    run_coarse,
    _roles,
    wants=("complete",),
    fillable=("perceptual",),
)
