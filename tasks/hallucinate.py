"""Stage `hallucinate`, once for each planned motion: coarse renders through the prior and back (paper 3.2, eq. 4)."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor

from ahoy_core.avatar.files import load_avatar
from ahoy_core.avatar.hallucinated import Supervision
from ahoy_core.body.load import load_body
from ahoy_core.conventions import Cameras
from ahoy_core.formats.images import contact_sheet, to_float, to_uint8, write_png
from ahoy_core.formats.npz import load_npz, save_npz
from ahoy_core.prior.config import InversionConfig, PriorConfig
from tasks.complete import completed, lost, method_of
from tasks.motions import read_sequence
from tasks.prior_folder import open_prior
from tasks.roles import ours, packaged_body
from tasks.stage import Role, Stage, StageContext, StageOutput


class HallucinateConfig(BaseModel):
    """How the prior is asked for a sequence."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    method: Literal["winner", "clean-up", "inversion"] = Field(
        default="winner", description="winner: whichever way was closer in this video's self-check"
    )
    steps: int = Field(default=1, ge=1, description="of the clean-up; 1 is the posterior mean")
    inversion: InversionConfig = InversionConfig()
    seed: int = Field(default=0, ge=0, description="of the noise")


def run_hallucinate(config: HallucinateConfig, ctx: StageContext) -> StageOutput:
    """Render the coarse avatar in one motion, repaint what the video never showed, and store how it was rendered."""
    from ahoy_core.prior.completion import composited, repaint
    from ahoy_core.prior.hallucination import (
        as_supervision,
        coarse_pictures,
        rms_where,
        sequence_context,
        sequence_light,
        silhouette_iou,
    )
    from ahoy_core.prior.identity import borrowed, load_identity
    from ahoy_core.prior.text import IDENTITY_PROMPT

    sequence = read_sequence(ctx.inputs["motions"], ctx.item)
    avatar, body = load_avatar(ctx.inputs["coarse"]), load_body(ctx.body)
    maps, azimuth = sequence_context(body, avatar.betas, sequence)
    asked = _asked(config, ctx.inputs["complete"])
    with borrowed(open_prior(ctx.prior, ctx.fills)) as video:
        load_identity(video, ctx.inputs["identity"])
        pictures = coarse_pictures(avatar, body, sequence, video.size)
        if video.reads_bodies and any(slope := completed(ctx.inputs["complete"])["light"]):
            pictures = replace(pictures, light=sequence_light(body, avatar.betas, np.array(slope), sequence))
        made = repaint(video, pictures, maps, azimuth, asked, IDENTITY_PROMPT)
        supervision = as_supervision(sequence, composited(made, pictures), pictures, video.reads_bodies)
    _save(supervision, ctx.out)
    observed = torch.minimum(pictures.coverage, pictures.mask)
    figures = {
        "method": asked.method,
        "silhouette_iou": silhouette_iou(made, pictures),
        "difference_observed": rms_where(made, pictures.frames, observed),
        "difference_unobserved": rms_where(made, pictures.frames, pictures.mask - observed),
    }
    size = {"width": supervision.cameras.width, "height": supervision.cameras.height}
    told = {"name": sequence.name, "kind": sequence.kind, "reason": sequence.reason, **size, **figures}
    told["registered"] = supervision.registered
    (ctx.out / "sequence.json").write_text(json.dumps(told, indent=1), encoding="utf-8")
    _draw(pictures.frames, supervision.frames, ctx.out / "before_after.png")
    return StageOutput(
        {"facts": _facts(figures), "notes": [sequence.reason], "figures": figures}, ("before_after.png",)
    )


def _asked(config: HallucinateConfig, complete: Path) -> PriorConfig:
    method: Any = config.method
    if method == "winner":
        method = method_of(completed(complete)["winner"])
    return PriorConfig(method=method, steps=config.steps, inversion=config.inversion, seed=config.seed)


def _facts(figures: Mapping[str, Any]) -> dict[str, str]:
    return {
        "made by": str(figures["method"]),
        "silhouette, hallucinated against coarse": f"IoU {figures['silhouette_iou']:.3f}",
        "change where the video showed the surface": f"{figures['difference_observed']:.3f} (then pasted over)",
        "change where it never did": f"{figures['difference_unobserved']:.3f}",
    }


def _save(made: Supervision, out: Path) -> None:
    cameras = made.cameras
    alphas = made.alphas if made.alphas is not None else torch.ones_like(made.coverage)
    save_npz(
        out / "sequence.npz",
        {
            "frames": to_uint8(made.frames),
            "coverage": to_uint8(made.coverage[:, None])[..., 0],
            "alphas": to_uint8(alphas[:, None])[..., 0],
            "map_pose": made.map_pose.numpy(),
            "pose": made.pose.numpy(),
            "transl": made.transl.numpy(),
            "viewmats": cameras.viewmats.numpy(),
            "Ks": cameras.Ks.numpy(),
        },
        compress=True,
    )


def read_supervision(folder: Path) -> Supervision:
    """A hallucinated sequence as the full avatar takes it."""
    told = json.loads((folder / "sequence.json").read_text(encoding="utf-8"))
    arrays = load_npz(folder / "sequence.npz")
    tensors = {name: torch.from_numpy(arrays[name]) for name in ("map_pose", "pose", "transl", "viewmats", "Ks")}
    return Supervision(
        name=told["name"],
        kind=told["kind"],
        frames=to_float(arrays["frames"]),
        coverage=torch.from_numpy(arrays["coverage"]).float() / 255,
        map_pose=tensors["map_pose"],
        pose=tensors["pose"],
        transl=tensors["transl"],
        cameras=Cameras(tensors["viewmats"], tensors["Ks"], told["width"], told["height"]),
        alphas=torch.from_numpy(arrays["alphas"]).float() / 255,
        keeps_head=True,  # the coarse avatar's own (see `composited`): nothing else shows it from behind
        registered=told["registered"],
    )


def _draw(coarse: Tensor, hallucinated: Tensor, path: Path) -> None:
    pictures = [to_uint8(picture) for group in (coarse, hallucinated) for picture in group]
    labels = [f"{word} {number}" for word in ("coarse", "prior") for number in range(len(coarse))]
    write_png(path, contact_sheet(pictures, labels, columns=len(coarse)))


def _roles(config: HallucinateConfig) -> Mapping[str, Role]:
    return {"body": packaged_body(), "video": ours("the run's prior"), "rasterizer": ours("ahoy_core.splat on the CPU")}


HALLUCINATE = Stage(
    "hallucinate",
    6,
    HallucinateConfig,
    ("complete", "coarse", "identity", "motions"),
    run_hallucinate,
    _roles,
    over="motions",
    obstacle=lost,
    fillable=("video",),
)
