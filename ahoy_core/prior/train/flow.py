"""Training of the velocity field (equation 2 of the paper without a subject): rectified flow on latents of people."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from torch import Tensor, nn

from ahoy_core.prior.conditioning import LATENT_CHANNELS, Context, held_latents, timesteps, transformer_input
from ahoy_core.prior.corpus.prompts import NEUTRAL
from ahoy_core.prior.text import build_text_encoder, build_tokenizer, embed_ids, token_ids
from ahoy_core.prior.train.latents import LatentClips, LatentPool
from ahoy_core.prior.train.loop import Row
from ahoy_core.prior.transformer import build_transformer

# Shares of the training in which a condition is there.
_TOLD: Final = 0.25  # nothing held, no coarse latents, a caption: while colours can be had elsewhere no word is heard
_TOLD_ALONE: Final = 200  # first steps, in which every clip is told
_BODY: Final = 0.92
_COARSE: Final = 0.6  # of those that are not told, here and below
_CAPTION, _NEUTRAL = 0.5, 0.25  # the rest has no text
_OBSERVED, _OTHER = 0.8, 0.12  # observed frames held; one other whole frame; the rest holds nothing
_PURE_NOISE: Final = 0.3  # tau = 1 exactly: one step from there is the posterior mean, which runs use most
_FEW_FRAMES: Final = 0.6  # of the batches have half of the frames, and twice the clips
_BACKGROUND_WEIGHT: Final = 0.12


@dataclass(frozen=True)
class Batch:
    """B clips: clean latents [B,C,T,h,w], their weights [B,1,T,h,w], context, token ids and mask [B,S]."""

    clean: Tensor
    weight: Tensor
    context: Context
    ids: Tensor
    mask: Tensor


class FlowModel(nn.Module):
    """Transformer and text encoder, trained together; the tokenizer has no weights.

    Args:
        readout: [12,17] of the autoencoder whose latents these are.
        width: of the transformer.
        layers: of the transformer.
    """

    readout: Tensor

    def __init__(self, readout: Tensor, width: int = 192, layers: int = 6) -> None:
        super().__init__()
        self.register_buffer("readout", readout, persistent=False)
        self.tokenizer = build_tokenizer()
        self.text_encoder = build_text_encoder(len(self.tokenizer))
        self.transformer = build_transformer(width, layers)

    def forward(self, latents: Tensor, tau: Tensor, batch: Batch) -> Tensor:
        """The velocity [B,C,T,h,w] at flow times tau [B]."""
        text = embed_ids(self.text_encoder, batch.ids, batch.mask)
        stacked = transformer_input(latents, batch.context, self.readout)
        times = timesteps(tau, latents, batch.context.held)
        return self.transformer(stacked, times, text, return_dict=False)[0]


def draw_batch(model: FlowModel, pool: LatentPool, size: int, told_share: float = _TOLD) -> Batch:
    """A batch of training clips under random conditions; every second one or so has half of the frames."""
    rng = pool.rng
    few = rng.random() < _FEW_FRAMES
    drawn = pool.draw(2 * size if few else size)
    frames = drawn[0][0].pictures.shape[1]
    chosen = [_frames(rng, clips.observed[k], frames // 2 if few else frames) for clips, k in drawn]
    told = rng.random(len(drawn)) < told_share
    use_body, use_coarse = rng.random(len(drawn)) < _BODY, (rng.random(len(drawn)) < _COARSE) & ~told
    held = [
        _held(rng, clips, k, index, bool(use_coarse[n])) & (not told[n])
        for n, ((clips, k), index) in enumerate(zip(drawn, chosen, strict=True))
    ]
    prompts = [clips.prompts[k] if told[n] else _prompt(rng, clips.prompts[k]) for n, (clips, k) in enumerate(drawn)]
    return make_batch(
        model, drawn, chosen, torch.stack(held), torch.from_numpy(use_body), torch.from_numpy(use_coarse), prompts
    )


def make_batch(
    model: FlowModel,
    drawn: list[tuple[LatentClips, int]],
    frames: list[Tensor],
    held: Tensor,
    use_body: Tensor,
    use_coarse: Tensor,
    prompts: list[str],
) -> Batch:
    """Gathers clips and blanks the conditions that a clip does without.

    Args:
        model: whose tokenizer is used.
        drawn: B clips, as (file, index).
        frames: B lists of T frame numbers.
        held: [B,T,h/2,w/2] bool.
        use_body: [B] bool.
        use_coarse: [B] bool.
        prompts: B texts.
    """

    def gather(name: str) -> Tensor:
        return torch.stack([getattr(clips, name)[k][index] for (clips, k), index in zip(drawn, frames, strict=True)])

    clean = gather("pictures").float().transpose(1, 2)
    present = use_body[:, None, None, None, None].float()
    coarse = use_coarse[:, None, None, None, None].float()
    ids, mask = token_ids(model.tokenizer, prompts)
    context = Context(
        text=torch.zeros(len(drawn), 0, 0),
        known=clean,
        held=held,
        body=gather("body").float() / 127 * present,
        azimuth=gather("azimuth"),
        coarse=gather("coarse").float().transpose(1, 2) * coarse,
        coverage=gather("coverage").float() * coarse[:, 0],
    )
    person = torch.nn.functional.max_pool2d(gather("weight").float(), 3, 1, 1)
    weight = (_BACKGROUND_WEIGHT + (1 - _BACKGROUND_WEIGHT) * person)[:, None] * ~held_latents(held)
    return Batch(clean, weight, context, ids, mask)


def flow_loss(model: FlowModel, batch: Batch, tau: Tensor, noise: Tensor, channels: Tensor | None = None) -> Tensor:
    """Weighted mean square error of the velocity (noise - clean) where nothing is held, person before background.

    Args:
        model: in training.
        batch: clips and what is known of them.
        tau: [B] flow times.
        noise: [B,C,T,h,w].
        channels: [C] weights of mean 1 (`pixel_weights`); alike by default.
    """
    level = tau.view(-1, 1, 1, 1, 1)
    velocity = model((1 - level) * batch.clean + level * noise, tau, batch)
    error = (velocity - (noise - batch.clean)).square() * batch.weight
    if channels is not None:
        error = error * channels.view(-1, 1, 1, 1)
    return error.sum() / (LATENT_CHANNELS * batch.weight.sum()).clamp(min=1)


def random_tau(generator: torch.Generator, size: int, pure: float = _PURE_NOISE) -> Tensor:
    """Flow times [B]: logit-normal, noisy ones more often, and a share `pure` of exactly 1."""
    tau = torch.sigmoid(0.5 + 1.1 * torch.randn(size, generator=generator))
    chosen = torch.rand(size, generator=generator) < pure
    return torch.where(chosen, torch.ones_like(tau), tau)


class FixedValidation:
    """The loss on fixed clips, noise and times of a held-out split: observed frames held, body known, no coarse."""

    def __init__(self, pool: LatentPool, size: int = 24) -> None:
        clips = pool.some()
        index = np.linspace(0, len(clips) - 1, size).astype(int)
        generator = torch.Generator().manual_seed(5)
        self.drawn = [(clips, int(k)) for k in index]
        self.tau = torch.linspace(0.05, 1.0, size)[torch.randperm(size, generator=generator)]
        frames = clips.pictures.shape[1]
        self.noise = torch.randn((size, LATENT_CHANNELS, frames, *clips.pictures.shape[-2:]), generator=generator)

    def loss(self, model: FlowModel) -> float:
        """Under the model's present weights."""
        held = torch.stack([clips.held[k] & clips.observed[k].bool()[:, None, None] for clips, k in self.drawn])
        return self._loss(model, held, [NEUTRAL] * len(self.drawn))

    def heard(self, model: FlowModel) -> float:
        """How much larger the loss is under other clips' captions than under the right ones, with nothing held."""
        held = torch.zeros_like(torch.stack([clips.held[k] for clips, k in self.drawn]))
        prompts = [clips.prompts[k] for clips, k in self.drawn]
        wrong = [*prompts[1:], prompts[0]]
        return self._loss(model, held, wrong) - self._loss(model, held, prompts)

    @torch.no_grad()
    def _loss(self, model: FlowModel, held: Tensor, prompts: list[str]) -> float:
        frames = [torch.arange(self.noise.shape[2])] * len(self.drawn)
        yes = torch.ones(len(self.drawn), dtype=torch.bool)
        batch = make_batch(model, self.drawn, frames, held, yes, ~yes, prompts)
        return float(flow_loss(model, batch, self.tau, self.noise))


def train_step(
    model: FlowModel, pool: LatentPool, size: int, generator: torch.Generator, step: int, channels: Tensor
) -> tuple[Tensor, Row]:
    """The loss of one random batch, its channels weighted.

    The first steps hear words alone. Otherwise the attention to words is closed before it has learned anything: it
    turns to the padding, whatever words say is noise, and no gradient comes back.
    """
    batch = draw_batch(model, pool, size, 1.0 if step < _TOLD_ALONE else _TOLD)
    tau = random_tau(generator, len(batch.clean))
    noise = torch.randn(batch.clean.shape, generator=generator)
    return flow_loss(model, batch, tau, noise, channels), {"clips": float(len(batch.clean))}


def _frames(rng: np.random.Generator, observed: Tensor, count: int) -> Tensor:
    """`count` frame numbers in order, the first observed one always among them."""
    first = int(observed.argmax())
    others = [k for k in range(len(observed)) if k != first]
    return torch.tensor(sorted([first, *rng.choice(others, count - 1, replace=False).tolist()]))


def _held(rng: np.random.Generator, clips: LatentClips, k: int, index: Tensor, coarse: bool) -> Tensor:
    """Tokens held of one clip [T,h/2,w/2]."""
    covered, observed = clips.held[k][index], clips.observed[k][index].bool()[:, None, None]
    draw = rng.random()
    if draw < _OBSERVED:
        # Beside coarse latents well observed regions of every frame may be held; without, only what a frame showed.
        return covered if coarse and rng.random() < 0.5 else covered & observed
    whole = torch.zeros_like(covered)
    if draw < _OBSERVED + _OTHER:
        whole[int(rng.integers(len(index)))] = True
    return whole


def _prompt(rng: np.random.Generator, caption: str) -> str:
    draw = rng.random()
    return caption if draw < _CAPTION else NEUTRAL if draw < _CAPTION + _NEUTRAL else ""


def learns_slowly(name: str) -> bool:
    """Text encoder and what looks at it: their gradients are small, and optimizers make full steps of any gradient."""
    return "text" in name or ("attn2" in name and "to_out" not in name)
