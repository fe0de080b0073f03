"""Stage `identity`: fine-tunes the prior on the subject: a low-rank update and one word (paper 3.2, equation 2)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from pydantic import Field
from torch import Tensor

from ahoy_core.body.load import load_body
from ahoy_core.body.rotations import axis_angle_to_matrix
from ahoy_core.conventions import Cameras
from ahoy_core.formats.images import contact_sheet, to_float, to_uint8, write_png
from ahoy_core.formats.npz import load_npz
from ahoy_core.prior.config import IdentityConfig
from tasks.complete import completed, lost
from tasks.prior_folder import open_prior
from tasks.roles import ours, packaged_body
from tasks.stage import Role, Stage, StageContext, StageOutput

SHOWN = 6
_FIT_ARRAYS = ("pose", "transl", "betas", "used", "viewmat", "K")


class IdentityStageConfig(IdentityConfig):
    """The fine-tuning's knobs, and how many frames it sees."""

    frames: int = Field(default=24, ge=1, description="person images, evenly spread over the usable frames")


def run_identity(config: IdentityStageConfig, ctx: StageContext) -> StageOutput:
    """Fine-tune, save in diffusers' LoRA format, and show the subject as the prior draws it before and after."""
    from ahoy_core.prior.corpus.prompts import NEUTRAL
    from ahoy_core.prior.identity import borrowed, save_identity, train_identity
    from ahoy_core.prior.text import IDENTITY_PROMPT

    with borrowed(open_prior(ctx.prior, ctx.fills)) as video:
        frames = subject(ctx, config.frames, video.size, even=video.reads_bodies)
        before = drawn(video, frames, NEUTRAL, config.seed)
        losses = train_identity(video, frames, config, lambda done: ctx.progress(done, config.steps, "steps")).losses
        after = drawn(video, frames, IDENTITY_PROMPT, config.seed)
        save_identity(video, ctx.out)
    table = {"step": list(range(1, len(losses) + 1)), "loss": losses.tolist()}
    pq.write_table(pa.table(table), ctx.out / "losses.parquet")
    _plot(losses.numpy(), ctx.out / "losses.png")
    _draw(frames, before, after, ctx.out / "before_after.png")
    errors = {word: colour_error(made, frames) for word, made in (("before", before), ("after", after))}
    facts = {
        "frames": len(frames.images),
        "colour error where the subject is visible": f"{errors['before']:.3f} before, {errors['after']:.3f} after",
    }
    return StageOutput({"facts": facts, "colour_errors": errors}, ("before_after.png", "losses.png"))


def subject(ctx: StageContext, count: int, size: tuple[int, int], even: bool) -> Any:
    """The subject's person images (`ahoy_core.prior.identity.Frames`).

    Args:
        ctx: with the artifacts `ingest` (frames), `perceive` (fit and masks) and `complete` (light).
        count: at most.
        size: height and width of the images, pixels.
        even: without the light that the video was seen in, as `repaint` asks a prior that reads bodies.
    """
    from ahoy_core.prior.light import brightness_on
    from ahoy_core.prior.subject import subject_frames

    ingest, perceive = ctx.inputs["ingest"], ctx.inputs["perceive"]
    fit = {name: torch.from_numpy(value) for name, value in load_npz(perceive / "body.npz", list(_FIT_ARRAYS)).items()}
    usable = torch.nonzero(fit["used"]).flatten()
    rows = usable[torch.linspace(0, len(usable) - 1, min(count, len(usable))).round().long()]
    body, number = load_body(ctx.body), len(rows)
    images = to_float(load_npz(ingest / "frames.npz", ["frames"])["frames"][rows.numpy()])
    masks = torch.from_numpy(load_npz(perceive / "masks.npz", ["visible"])["visible"][rows.numpy()]).float() / 255
    with torch.no_grad():
        posed = body(fit["pose"][rows], fit["betas"][None].expand(number, -1), fit["transl"][rows])
    cameras = Cameras(
        fit["viewmat"].expand(number, 4, 4), fit["K"].expand(number, 3, 3), images.shape[-1], images.shape[-2]
    )
    roots = axis_angle_to_matrix(fit["pose"][rows, 0])
    slope = np.array(completed(ctx.inputs["complete"])["light"])
    brightness = brightness_on(body, fit["betas"].numpy(), slope) if even and slope.any() else None
    return subject_frames(images, masks[:, None], cameras, body, posed.vertices, roots, size, brightness)


@torch.no_grad()
def drawn(video: Any, frames: Any, prompt: str, seed: int) -> Tensor:
    """Posterior means [n,3,H,W] of some of the frames from body and words alone, each by itself."""
    from ahoy_core.prior.conditioning import Context
    from ahoy_core.prior.inversion import clean_up

    rows = shown(len(frames.images))
    text = video.embed([prompt]).expand(len(rows), -1, -1)
    context = Context(text, body=frames.body[rows][:, None], azimuth=frames.azimuth[rows][:, None])
    like = video.encode(frames.images[rows][:, :, None])
    noise = torch.randn(like.shape, generator=torch.Generator().manual_seed(seed))
    made: Tensor = video.decode(clean_up(video, noise, context).latents)[:, :, 0]
    return made


def shown(count: int) -> Tensor:
    """Which of the frames are drawn."""
    return torch.linspace(0, count - 1, min(SHOWN, count)).round().long()


def colour_error(made: Tensor, frames: Any) -> float:
    """Distance of mean colours where the subject is visible: root mean square over frames and channels."""
    rows = shown(len(frames.images))
    weight = frames.visible[rows]
    area = weight.sum((2, 3)).clamp(min=1e-6)
    difference = ((made - frames.images[rows]) * weight).sum((2, 3)) / area
    return float(difference.square().mean().sqrt())


def _draw(frames: Any, before: Tensor, after: Tensor, path: Path) -> None:
    rows = shown(len(frames.images))
    pictures = [to_uint8(picture) for group in (frames.images[rows], before, after) for picture in group]
    words = ("seen", "before", "after")
    labels = [f"{word} {number}" for word in words for number in range(len(rows))]
    write_png(path, contact_sheet(pictures, labels, columns=len(rows)))


def _plot(losses: np.ndarray, path: Path) -> None:
    matplotlib.use("agg")
    from matplotlib import pyplot

    figure, axis = pyplot.subplots(figsize=(7, 2.5), dpi=110)
    axis.plot(np.arange(1, len(losses) + 1), losses, linewidth=0.8)
    axis.set(xlabel="step", ylabel="loss of the velocity")
    figure.tight_layout()
    figure.savefig(path)
    pyplot.close(figure)


def _roles(config: IdentityStageConfig) -> Mapping[str, Role]:
    return {"body": packaged_body(), "video": ours("the run's prior")}


IDENTITY = Stage(
    "identity",
    3,
    IdentityStageConfig,
    ("ingest", "perceive", "complete"),
    run_identity,
    _roles,
    obstacle=lost,
    fillable=("video",),
)
