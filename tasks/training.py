"""What the stages `coarse` and `avatar` share: reading their inputs, and telling how a training went."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch

from ahoy_core.avatar.avatar import Avatar
from ahoy_core.avatar.coarse import CoarseResult, LossRow
from ahoy_core.avatar.compare import observed_pairs
from ahoy_core.avatar.full import FullResult
from ahoy_core.avatar.held_out import HeldOut
from ahoy_core.avatar.supervision import CoarseInputs
from ahoy_core.avatar.trainer import FullRow
from ahoy_core.body.load import PACKAGED, load_body
from ahoy_core.conventions import Cameras
from ahoy_core.formats.images import contact_sheet, to_float, write_png
from ahoy_core.formats.npz import load_npz
from tasks.stage import StageContext

PAIRS_SHOWN = 4


def draw_training(result: CoarseResult | FullResult, terms: Sequence[str], inputs: CoarseInputs, out: Path) -> None:
    """Write the losses as a table and a plot, and the comparison with the video."""
    pq.write_table(pa.Table.from_pylist([dataclasses.asdict(row) for row in result.losses]), out / "losses.parquet")
    _plot_losses(result.losses, terms, out / "losses.png")
    compare(inputs, result.avatar, out / "compare.png")


def completed_texture(ctx: StageContext) -> Path:
    """The folder of atlas and canonical views: as the stage `complete` left them, where it ran."""
    return ctx.inputs.get("complete", ctx.inputs["texture"])


def load_inputs(ingest: Path, perceive: Path, texture: Path, body: str = PACKAGED) -> CoarseInputs:
    """Read what equation 1 asks for from three artifact folders."""
    frames = load_npz(ingest / "frames.npz", ["frames"])["frames"]
    fit = {name: torch.from_numpy(value) for name, value in load_npz(perceive / "body.npz").items()}
    masks = load_npz(perceive / "masks.npz", ["visible", "amodal"])
    atlas, canonical = load_npz(texture / "atlas.npz"), load_npz(texture / "canonical.npz")
    height, width = canonical["views"].shape[1:3]
    viewmats, Ks = torch.from_numpy(canonical["viewmats"]), torch.from_numpy(canonical["Ks"])
    return CoarseInputs(
        body=load_body(body),
        betas=fit["betas"],
        pose=fit["pose"],
        transl=fit["transl"],
        frames=torch.from_numpy(np.ascontiguousarray(np.moveaxis(frames, -1, 1))),
        masks=torch.from_numpy(masks["visible"]),
        silhouettes=torch.from_numpy(masks["amodal"]),
        viewmat=fit["viewmat"],
        K=fit["K"],
        used=fit["used"],
        confidence=fit["frame_confidence"],
        views=to_float(canonical["views"]),
        view_coverage=torch.from_numpy(canonical["coverage"]).float() / 255,
        view_cameras=Cameras(viewmats, Ks, width, height, "ortho"),
        atlas=to_float(atlas["filled_rgb"]),
        atlas_coverage=torch.from_numpy(atlas["coverage"]),
    )


def training_summary(result: CoarseResult | FullResult, before: str) -> dict[str, Any]:
    """What a training has to say of itself.

    Args:
        result: of it.
        before: what the scores before it are those of.
    """
    share = result.avatar.observed_share
    facts: dict[str, Any] = {"gaussians": len(result.avatar), "steps": len(result.losses)}
    if (score := result.held_out) is not None:
        facts["held-out frame, PSNR"] = f"{score.psnr_after:.2f} dB ({score.psnr_before:.2f} {before})"
        facts["held-out frame, SSIM"] = f"{score.ssim_after:.3f} ({score.ssim_before:.3f} {before})"
        facts["protocol"] = score.protocol
    invented = f"{share:.0%} of the surface was observed in the video, {1 - share:.0%} was invented."
    return {"facts": facts, "notes": list(result.notes), "invented": invented, "observed_share": share}


def held_out_rows(score: HeldOut | None, after: str, before: str | None = None) -> list[dict[str, Any]]:
    """Rows of the table `metrics` for the held-out frame.

    Args:
        score: None where no frame was held out: no rows then.
        after: name of the configuration that was trained.
        before: name of what it started from, if that is to have a row as well.
    """
    if score is None:
        return []
    same = {"protocol": "input-view", "protocol_id": score.protocol, "region": "mask box", "camera": "observed"}
    row = {**same, "frame": score.frame, "input_setting": "video"}
    first = [{**row, "config": before, "psnr": score.psnr_before, "ssim": score.ssim_before}] if before else []
    return [*first, {**row, "config": after, "psnr": score.psnr_after, "ssim": score.ssim_after}]


def compare(inputs: CoarseInputs, avatar: Avatar, path: Path) -> None:
    """Draw observed frames beside the avatar in their pose."""
    used = torch.nonzero(inputs.used).flatten().tolist()
    chosen = [used[i * len(used) // PAIRS_SHOWN] for i in range(min(PAIRS_SHOWN, len(used)))]
    pictures: list[np.ndarray] = []
    labels: list[str] = []
    for number, (seen, made) in zip(chosen, observed_pairs(avatar, inputs, chosen), strict=True):
        pictures += [seen, made]
        labels += [f"frame {number}", "avatar"]
    write_png(path, contact_sheet(pictures, labels, columns=4, cell=320))


def _plot_losses(rows: Sequence[LossRow] | Sequence[FullRow], terms: Sequence[str], path: Path) -> None:
    """Draw terms of the objective by step, and the held-out frame's score."""
    matplotlib.use("agg")
    from matplotlib import pyplot

    figure, axis = pyplot.subplots(figsize=(7, 3), dpi=110)
    steps = [row.step for row in rows]
    for name in terms:
        axis.plot(steps, [getattr(row, name) for row in rows], label=name, linewidth=1)
    axis.set(xlabel="step", ylabel="loss", yscale="log")
    checks = [(row.step, row.held_out_psnr) for row in rows if not np.isnan(row.held_out_psnr)]
    if checks:
        twin = axis.twinx()
        twin.plot(*zip(*checks, strict=True), "k.-", linewidth=0.8, label="held-out frame")
        twin.set_ylabel("held-out PSNR, dB")
    axis.legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(path)
    pyplot.close(figure)
