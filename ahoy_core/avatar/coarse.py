"""The coarse avatar: training of the canonical StyleUNet by equation 1 (paper section 3.1)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ahoy_core.avatar.avatar import Avatar, AvatarInfo, bake, network_config
from ahoy_core.avatar.config import CoarseConfig
from ahoy_core.avatar.deform import Canonical, apply_offsets, deform, dense_weights, offset_channels
from ahoy_core.avatar.held_out import HeldOut, Progress
from ahoy_core.avatar.losses import Neighbourhood, masked_l1, photometric, regularisers
from ahoy_core.avatar.render import Rendered, render
from ahoy_core.avatar.supervision import CanonicalViews, CoarseInputs, Frame, canonical_views, observed_frames
from ahoy_core.maps.style_unet import StyleUNet
from ahoy_core.maps.template import Template, build_template
from ahoy_core.metrics import INPUT_VIEW, input_view_pair, psnr, ssim
from ahoy_core.metrics.perceptual import Perceptual, patch_distance
from ahoy_core.texture.texels import sample_atlas

_NAN = float("nan")
# A frame is held out only where at least this many are left to learn from.
_MIN_FRAMES_FOR_HOLD_OUT = 4


@dataclass(frozen=True)
class LossRow:
    """Terms of one step, weighted as they entered `total`; NaN where a term was not evaluated."""

    step: int
    total: float
    canonical: float
    observed: float
    regularisers: float
    perceptual: float
    held_out_psnr: float


@dataclass(frozen=True)
class CoarseResult:
    """The avatar, one row per step, the held-out score (None without enough frames), and what was skipped and why."""

    avatar: Avatar
    losses: tuple[LossRow, ...]
    held_out: HeldOut | None
    notes: tuple[str, ...]


def textured_template(inputs: CoarseInputs, map_size: int) -> Template:
    """The canonical template with the atlas's colours: the avatar at step 0."""
    template = build_template(inputs.body, inputs.betas, map_size)
    uv = template.uv.numpy()
    colors = sample_atlas(inputs.atlas.float().permute(1, 2, 0).numpy(), uv)
    observed = sample_atlas(inputs.atlas_coverage.float().numpy(), uv)
    return template.paint(torch.from_numpy(colors).clamp(0, 1), torch.from_numpy(observed))


def train_coarse(
    inputs: CoarseInputs,
    config: CoarseConfig,
    info: AvatarInfo,
    progress: Progress | None = None,
    *,
    perceptual: Perceptual | None = None,
) -> CoarseResult:
    """Train the coarse avatar (paper section 3.1, equation 1).

    One pass of the network serves all views of a step. The same inputs, configuration and number of threads give the
    same avatar, bit for bit.

    Args:
        inputs: Canonical views, observed frames, atlas, body.
        config: Sizes, steps, weights, seed.
        info: What the avatar's file shall say.
        progress: Called after every step.
        perceptual: The perceptual role; None leaves that loss out.

    Returns:
        The avatar of the step with the best held-out score (the last step where no frame is held out).

    Raises:
        ValueError: If inputs do not fit together.
    """
    frames, notes = observed_frames(inputs, config.max_frames)
    views, more = canonical_views(inputs, config.weights)
    notes += more
    held_out = frames.pop(len(frames) // 2) if len(frames) > _MIN_FRAMES_FOR_HOLD_OUT else None
    if held_out is None:
        notes.append(f"no frame held out: {len(frames)} usable, more than {_MIN_FRAMES_FOR_HOLD_OUT} needed")
    template = textured_template(inputs, config.map_size)
    run = _Run(template, frames, views, held_out, config, inputs.body.n_joints, perceptual)
    run.train(progress)
    poses = torch.stack([inputs.pose[frame.number] for frame in frames]) if frames else inputs.pose[:0]
    avatar = bake(template, run.network, config.bounds, inputs.betas, poses.float(), info)
    score = None
    if held_out is not None:
        before, after = run.score_of_template, run.score()
        protocol = INPUT_VIEW.id(inputs.frames.shape[2], inputs.frames.shape[3])
        score = HeldOut(held_out.number, protocol, before[0], after[0], before[1], after[1])
    return CoarseResult(avatar, tuple(run.rows), score, (*notes, *run.notes))


class _Run:
    """State of one training: network, optimiser, random numbers, rows."""

    def __init__(
        self,
        template: Template,
        frames: Sequence[Frame],
        views: CanonicalViews,
        held_out: Frame | None,
        config: CoarseConfig,
        n_joints: int,
        perceptual: Perceptual | None,
    ) -> None:
        self.perceptual = perceptual if config.weights.perceptual > 0 else None
        self.template, self.frames, self.held_out = template, frames, held_out
        self.views = weigh_head(views, template, config.weights.head)
        self.config, self.n_joints = config, n_joints
        self.generator = torch.Generator().manual_seed(config.seed)
        sizes = network_config(template, config.width, offset_channels(template))
        self.network = StyleUNet(sizes, self.generator)
        self.optimizer = torch.optim.Adam(self.network.parameters(), lr=config.learning_rate, betas=(0.9, 0.99))
        self.maps, self.around = template.maps(), Neighbourhood.of(template)
        self.rows: list[LossRow] = []
        self.notes: list[str] = []
        self.score_of_template = self.score()
        self.best = (self.score_of_template[0], deepcopy(self.network.state_dict()))

    def train(self, progress: Progress | None) -> None:
        """All steps, or as many as the held-out frame allows; ends with the best network loaded."""
        config, worse, skipped = self.config, 0, 0
        for step in range(1, config.steps + 1):
            for group in self.optimizer.param_groups:
                group["lr"] = config.learning_rate * _schedule(step / config.steps)
            terms = self._losses()
            total = torch.stack(list(terms)).sum()
            self.optimizer.zero_grad()
            if bool(torch.isfinite(total)):
                total.backward()
                self.optimizer.step()
            else:
                skipped += 1
            check = self.held_out is not None and (step % config.check_every == 0 or step == config.steps)
            score = self.score()[0] if check else _NAN
            values = [float(x.detach()) for x in (total, *terms)]
            self.rows.append(LossRow(step, values[0], values[1], values[2], values[3], values[4], score))
            if progress is not None:
                progress(step, config.steps, self.rows[-1].total)
            if score > self.best[0]:
                self.best = (score, deepcopy(self.network.state_dict()))
            worse = worse + 1 if score < self.best[0] - config.tolerance else 0 if check else worse
            if worse >= config.patience:
                self.notes.append(f"stopped at step {step}: the held-out frame got worse in {worse} checks")
                break
        if skipped:
            self.notes.append(f"{skipped} steps left out: their loss was not finite")
        if self.held_out is not None:
            self.network.load_state_dict(self.best[1])

    def _losses(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Canonical term, observed term, regularisers and perceptual term of a random batch of views, weighted."""
        config = self.config
        canonical = self._canonical()
        covars = canonical.covars()
        lbs_weights = dense_weights(self.template.skin_indices, canonical.skin_weights, self.n_joints)
        first = self._view_loss(canonical, covars, self._draw(len(self.views.cameras), config.views_per_step))
        second, fourth = first.new_zeros(()), first.new_zeros(())
        chosen = self._draw(len(self.frames), config.frames_per_step)
        for number in chosen:
            frame = self.frames[number]
            means, posed = deform(canonical.means, covars, lbs_weights, frame.relative)
            rendered = render(means, posed, canonical.opacities, canonical.colors, frame.camera)
            second = second + self._frame_loss(rendered, frame) / len(chosen)
            if self.perceptual is not None and number == chosen[0]:
                image, side = rendered.images[0], config.patch
                fourth = patch_distance(self.perceptual, image, frame.target, frame.weight, side, self.generator)
        weights = config.weights
        third = regularisers(canonical, self.template, self.around, weights)
        return weights.canonical * first, weights.observed * second, third, weights.perceptual * fourth

    def _frame_loss(self, rendered: Rendered, frame: Frame) -> Tensor:
        weights, alpha = self.config.weights, rendered.alphas[0]
        loss = photometric(rendered.images[0], frame.target, frame.weight, weights.gradient)
        area = frame.weight.sum()
        empty = masked_l1(alpha, torch.zeros_like(alpha), frame.empty, area)
        solid = masked_l1(alpha, torch.ones_like(alpha), frame.weight, area)
        return loss + weights.empty * empty + weights.solid * solid

    def _view_loss(self, canonical: Canonical, covars: Tensor, chosen: list[int]) -> Tensor:
        views, weights = self.views, self.config.weights
        image, alpha = render(canonical.means, covars, canonical.opacities, canonical.colors, views.cameras[chosen])
        weight, target_alpha = views.weight[chosen], views.alpha[chosen]
        # Over the person's area, as the observed term: the empty part of a canonical view must not dilute its errors.
        area = (weight * target_alpha).sum()
        loss = photometric(image, views.target[chosen], weight, weights.gradient, area)
        return loss + weights.alpha * masked_l1(alpha, target_alpha, weight, area)

    def _canonical(self) -> Canonical:
        return apply_offsets(self.template, self.template.gather(self.network(self.maps)), self.config.bounds)

    def _draw(self, count: int, wanted: int) -> list[int]:
        return torch.randperm(count, generator=self.generator)[:wanted].tolist()

    @torch.no_grad()
    def score(self) -> tuple[float, float]:
        """PSNR and SSIM of the held-out frame; NaN without one."""
        frame = self.held_out
        if frame is None:
            return _NAN, _NAN
        canonical = self._canonical()
        lbs_weights = dense_weights(self.template.skin_indices, canonical.skin_weights, self.n_joints)
        means, covars = deform(canonical.means, canonical.covars(), lbs_weights, frame.relative)
        image = render(means, covars, canonical.opacities, canonical.colors.clamp(0, 1), frame.camera).images[0]
        mask = frame.weight[0] / frame.weight.max().clamp(min=1e-6)
        pair = input_view_pair(image, frame.target, mask)
        return psnr(*pair), ssim(*pair)


@torch.no_grad()
def weigh_head(views: CanonicalViews, template: Template, factor: float) -> CanonicalViews:
    """The canonical views with the weight of the head's pixels times `factor`."""
    half = template.rotations * template.scales[:, None, :]
    head = template.head[:, None].to(template.means).repeat(1, 3)
    shown = render(template.means, half @ half.transpose(1, 2), template.opacities, head, views.cameras, background=0.0)
    return replace(views, weight=views.weight * (1 + (factor - 1) * shown.images[:, :1]))


def _schedule(progress: float) -> float:
    """Learning rate over its start: a short warm-up, then half a cosine down to 5%."""
    return min(1.0, 20 * progress) * (0.05 + 0.95 * 0.5 * (1 + math.cos(math.pi * progress)))
