"""The full avatar: training of pose-dependent Gaussians on inconsistent supervision (paper section 3.3, equation 9)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from ahoy_core.avatar.avatar import Avatar, AvatarInfo
from ahoy_core.avatar.checkpoint import load_checkpoint, save_checkpoint
from ahoy_core.avatar.full_config import FullConfig
from ahoy_core.avatar.full_inputs import FullInputs, Plan, make_plan
from ahoy_core.avatar.held_out import HeldOut, Progress
from ahoy_core.avatar.trainer import FullRow, Trainer
from ahoy_core.metrics import INPUT_VIEW
from ahoy_core.metrics.perceptual import Perceptual

Preview = Callable[[int, Tensor], None]
"""Called at every check with the step and a picture [3,H,W] in [0,1]: targets above, renders below."""


@dataclass(frozen=True)
class FullResult:
    """What `train_full` made.

    Attributes:
        avatar: The avatar; pose-dependent unless the switches say otherwise.
        losses: One row per step.
        held_out: None without enough observed frames.
        notes: What was skipped, and why.
        corrections: The largest correction of each kind, as a share of its bound.
    """

    avatar: Avatar
    losses: tuple[FullRow, ...]
    held_out: HeldOut | None
    notes: tuple[str, ...]
    corrections: dict[str, float]


def train_full(
    inputs: FullInputs,
    config: FullConfig,
    info: AvatarInfo,
    progress: Progress | None = None,
    *,
    perceptual: Perceptual | None = None,
    preview: Preview | None = None,
    checkpoint: Path | None = None,
) -> FullResult:
    """Train the full avatar.

    One pass of the network per map pose serves all frames of a step that share it. The same inputs, configuration and
    number of threads give the same avatar, bit for bit, also when it was interrupted and went on from a checkpoint.

    Args:
        inputs: Observed frames, hallucinated sequences, face views, template.
        config: Sizes, steps, weights, switches, seed.
        info: What the avatar's file shall say.
        progress: Called after every step.
        perceptual: The perceptual role; None leaves L_per out (noted).
        preview: Called with a picture at every check.
        checkpoint: File to go on from and to write to; removed by whoever keeps the result.

    Raises:
        ValueError: If there is nothing to learn from, or the inputs do not fit together.
    """
    plan = make_plan(inputs, config)
    trainer = Trainer(inputs, plan, config, perceptual)
    _train(trainer, config, progress, preview, checkpoint)
    notes = [*plan.notes, *trainer.objective.notes, *trainer.notes]
    poses = _training_poses(inputs, plan)
    avatar = trainer.avatar(inputs.observed.betas, poses, info)
    return FullResult(
        avatar, tuple(trainer.rows), _held_out(trainer, plan, inputs), tuple(notes), trainer.corrections.largest()
    )


def _train(
    trainer: Trainer,
    config: FullConfig,
    progress: Progress | None,
    preview: Preview | None,
    checkpoint: Path | None,
) -> None:
    fingerprint = f"{config.model_dump_json()} {trainer.fingerprint()}"
    state = load_checkpoint(checkpoint, fingerprint) if checkpoint is not None else None
    if state is not None:
        trainer.load_state(state)
    while trainer.step < config.steps and not trainer.stopped:
        trainer.advance()
        checked = trainer.step % config.check_every == 0 or trainer.step == config.steps
        if checked:
            trainer.check()
            if preview is not None:
                preview(trainer.step, trainer.picture())
            if checkpoint is not None:
                save_checkpoint(checkpoint, fingerprint, trainer.state())
        if progress is not None:
            progress(trainer.step, config.steps, trainer.rows[-1].total)
    trainer.finish()


def _training_poses(inputs: FullInputs, plan: Plan) -> Tensor:
    """[T,J,3] poses that the avatar was trained in: of the observed frames and of the sequences."""
    observed = inputs.observed
    rows = [observed.pose[observed.used & torch.isfinite(observed.pose).flatten(1).all(1)].float()]
    rows += [sequence.map_pose[None].float() for sequence in inputs.sequences if plan.hallucinated]
    return torch.cat(rows)


def _held_out(trainer: Trainer, plan: Plan, inputs: FullInputs) -> HeldOut | None:
    if plan.held_out is None:
        return None
    before, after = trainer.first_score, trainer.score()
    protocol = INPUT_VIEW.id(*inputs.observed.frames.shape[2:])
    return HeldOut(plan.held_out[0], protocol, before[0], after[0], before[1], after[1])
