"""Fine-tuning on one subject: low-rank updates and one learned word (paper, section 3.2, equation 2)."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import torch
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from ahoy_core.formats.atomic import atomic_path
from ahoy_core.prior.conditioning import Context
from ahoy_core.prior.config import IdentityConfig
from ahoy_core.prior.evidence import SEEN, Frames, holes_closed, with_mirrored
from ahoy_core.prior.text import (
    IDENTITY_PROMPT,
    IDENTITY_TOKEN,
    embedding_weight,
    identity_token_id,
    likeness_word,
)
from ahoy_core.prior.train.flow import random_tau
from ahoy_core.prior.video import VideoModel

ADAPTER: Final = "identity"
_TARGETS: Final = ["to_q", "to_k", "to_v", "to_out.0", "ffn.net.0.proj", "ffn.net.2"]
_FILES: Final = ("pytorch_lora_weights.safetensors", "pytorch_lora_weights_2.safetensors")
_TOKEN_FILE: Final = "learned_embeds.safetensors"


@dataclass(frozen=True)
class IdentityCurve:
    """The loss [steps] of a fine-tuning."""

    losses: Tensor


def experts(video: VideoModel) -> list[Any]:
    """The transformers of a video model: one, or A14B's two."""
    found = video.components.transformer, video.components.transformer_2
    return [network for network in found if network is not None]


def add_identity(video: VideoModel, rank: int, seed: int) -> None:
    """Puts a fresh adapter (which changes nothing yet) on attention and feed-forward layers of every expert.

    Raises:
        ValueError: when there is one already.
    """
    from peft import LoraConfig

    if has_identity(video):
        raise ValueError("expected a prior without an identity adapter, got one; load the prior anew for each subject")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        config = LoraConfig(r=rank, lora_alpha=rank, init_lora_weights="gaussian", target_modules=_TARGETS)
        for network in experts(video):
            network.requires_grad_(False)
            network.add_adapter(config, adapter_name=ADAPTER)
            for parameter in network.parameters():
                if parameter.requires_grad:  # updates are small: in half precision most would be lost
                    parameter.data = parameter.data.float()


@contextmanager
def borrowed(video: VideoModel) -> Iterator[VideoModel]:
    """A model for one subject: when the block ends, adapter and word are gone, and it is as it was loaded.

    Loading a published model takes minutes, so a process keeps it for the next subject.
    """
    number = identity_token_id(video.components.tokenizer)
    word = embedding_weight(video.components.text_encoder)[number].detach().clone()
    try:
        yield video
    finally:
        for network in experts(video):
            if ADAPTER in getattr(network, "peft_config", {}):
                network.unload_lora()
        with torch.no_grad():
            embedding_weight(video.components.text_encoder)[number] = word


def has_identity(video: VideoModel) -> bool:
    """Whether an adapter is there."""
    return ADAPTER in getattr(video.components.transformer, "peft_config", {})


@contextmanager
def without_identity(video: VideoModel) -> Iterator[None]:
    """The prior as it was before the fine-tuning, for as long as the block lasts."""
    adapted = [network for network in experts(video) if ADAPTER in getattr(network, "peft_config", {})]
    for network in adapted:
        network.disable_adapters()
    try:
        yield
    finally:
        for network in adapted:
            network.enable_adapters()


def train_identity(
    video: VideoModel, frames: Frames, config: IdentityConfig, progress: Callable[[int], None] = lambda done: None
) -> IdentityCurve:
    """Fine-tunes the prior on a subject: E ||(z1 - z0) - v(z_tau, tau; "a [v] person")||^2 over visible latents.

    Each frame is a video of one frame, so nothing of the order is learned. The adapter and the word stay in the model.
    A share of the times is 1 exactly: what colour a garment has is decided there and there alone, since at any lower
    time the noisy latents tell it.

    Args:
        video: without an adapter.
        frames: of the subject.
        config: knobs.
        progress: told of the steps done.

    Raises:
        FloatingPointError: when the loss is not finite.
    """
    add_identity(video, config.rank, config.seed)
    frames = holes_closed(frames)
    frames = with_mirrored(frames) if config.mirror else frames
    generator = torch.Generator().manual_seed(config.seed)
    with torch.no_grad():
        clean = video.encode(frames.images[:, :, None])
    size = frames.images.shape[-1] // clean.shape[-1]
    weight = (nn.functional.avg_pool2d(frames.visible, size) >= SEEN).float()[:, :, None]
    parts = video.components
    word = nn.Parameter(likeness_word(parts.tokenizer, parts.text_encoder).float())
    updates = [p for network in experts(video) for p in network.parameters() if p.requires_grad]
    groups = [{"params": updates, "lr": config.lr}, {"params": [word], "lr": config.token_lr}]
    optimizer = torch.optim.AdamW(groups, betas=(0.9, 0.99), weight_decay=0.0)
    losses = []
    with _spoken(video, word), _checkpointed(video):
        for step in range(config.steps):
            rows = torch.randint(len(clean), (config.batch,), generator=generator)
            tau = random_tau(generator, len(rows), config.pure_noise)
            loss = _identity_loss(video, clean[rows], weight[rows], _context(video, frames, rows), tau, generator)
            if not bool(torch.isfinite(loss)):
                raise FloatingPointError(f"expected a finite loss, got {float(loss.detach())} in step {step}; lower lr")
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            losses.append(float(loss.detach()))
            progress(len(losses))
    with torch.no_grad():
        embedding_weight(parts.text_encoder)[identity_token_id(parts.tokenizer)] = word
    for parameter in updates:
        parameter.requires_grad_(False)
    return IdentityCurve(torch.tensor(losses))


def save_identity(video: VideoModel, folder: Path) -> None:
    """Writes the adapter in diffusers' LoRA format (one file an expert) and the learned word.

    Args:
        video: after `train_identity`.
        folder: exists.
    """
    from diffusers import WanPipeline
    from peft.utils import get_peft_model_state_dict

    for network, name in zip(experts(video), _FILES, strict=False):
        metadata = network.peft_config[ADAPTER].to_dict()
        WanPipeline.save_lora_weights(
            folder,
            transformer_lora_layers=get_peft_model_state_dict(network, adapter_name=ADAPTER),
            weight_name=name,
            transformer_lora_adapter_metadata=metadata,
        )
    word = embedding_weight(video.components.text_encoder)[identity_token_id(video.components.tokenizer)]
    with atomic_path(folder / _TOKEN_FILE) as temporary:
        save_file({IDENTITY_TOKEN: word.detach().clone()}, temporary)


def load_identity(video: VideoModel, folder: Path) -> None:
    """Puts a saved subject into a fresh prior.

    Raises:
        FileNotFoundError: when a file for one of the experts is missing.
    """
    for network, name in zip(experts(video), _FILES, strict=False):
        if not (folder / name).is_file():
            raise FileNotFoundError(f"expected {name} in {str(folder)!r}, got none; run the identity stage again")
        network.load_lora_adapter(folder / name, prefix="transformer", adapter_name=ADAPTER, local_files_only=True)
        network.requires_grad_(False)
    word = load_file(folder / _TOKEN_FILE)[IDENTITY_TOKEN]
    with torch.no_grad():
        embedding_weight(video.components.text_encoder)[identity_token_id(video.components.tokenizer)] = word


def _context(video: VideoModel, frames: Frames, rows: Tensor) -> Context:
    text = video.embed([IDENTITY_PROMPT]).expand(len(rows), -1, -1)
    if frames.body is None or frames.azimuth is None:
        return Context(text)
    return Context(text, body=frames.body[rows][:, None], azimuth=frames.azimuth[rows][:, None])


def _identity_loss(
    video: VideoModel, clean: Tensor, weight: Tensor, context: Context, tau: Tensor, generator: torch.Generator
) -> Tensor:
    """Equation 2 on a batch [B,C,1,h,w] at flow times tau [B], averaged over visible latents."""
    noise = torch.randn(clean.shape, generator=generator)
    level = tau.view(-1, 1, 1, 1, 1)
    velocity = video.velocity((1 - level) * clean + level * noise, tau, context)
    error = (velocity - (noise - clean)).square() * weight
    return error.sum() / (clean.shape[1] * weight.sum()).clamp(min=1)


@contextmanager
def _checkpointed(video: VideoModel) -> Iterator[None]:
    """Within the block a published model's blocks compute their activations anew for the gradient, to fit a GPU."""
    large = [] if video.reads_bodies else experts(video)
    for network in large:
        network.enable_gradient_checkpointing()
    try:
        yield
    finally:
        for network in large:
            network.disable_gradient_checkpointing()


@contextmanager
def _spoken(video: VideoModel, word: nn.Parameter) -> Iterator[None]:
    """Within the block the encoder reads the identity token as `word`, without a gradient for the whole table."""
    number = identity_token_id(video.components.tokenizer)

    def replaced(_: nn.Module, inputs: tuple[Tensor, ...], output: Tensor) -> Tensor:
        return torch.where((inputs[0] == number)[..., None], word.to(output), output)

    video.components.text_encoder.requires_grad_(False)
    hook = video.components.text_encoder.encoder.embed_tokens.register_forward_hook(replaced)
    try:
        yield
    finally:
        hook.remove()


def fresh(video: VideoModel) -> VideoModel:
    """A deep copy, to fine-tune without touching the original."""
    return copy.deepcopy(video)
