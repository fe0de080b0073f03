"""The `video` role: frames to latents and back, text, and the velocity field, whichever model is behind them."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, Protocol, runtime_checkable

import torch
from torch import Tensor

from ahoy_core.prior.conditioning import Context, hold, timesteps, transformer_input
from ahoy_core.prior.format import Components, load_components
from ahoy_core.prior.framing import HEIGHT, WIDTH
from ahoy_core.prior.text import add_identity_token, embed_ids, token_ids

WAN_HEIGHT: Final = 832
"""Pixels: the longer side of the smaller size that Wan 2.2 was trained at."""


@runtime_checkable
class VideoModel(Protocol):
    """A rectified-flow video model: z_tau = (1 - tau) data + tau noise, velocity = noise - data.

    Frames are [B,3,T,H,W] float32 RGB in [0,1]; latents [B,C,t,h,w], normalized.
    """

    @property
    def components(self) -> Components:
        """The networks, for fine-tuning."""
        ...

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the person images that it is asked for, pixels."""
        ...

    @property
    def reads_bodies(self) -> bool:
        """Whether body maps, azimuths and coarse latents condition it; where not, they change nothing."""
        ...

    @property
    def holds_first_frame(self) -> bool:
        """Whether a first frame that is held clean conditions it, of models that read no bodies."""
        ...

    def clip_frames(self, frames: int) -> int:
        """Frames of the shortest clip that it codes and that has `frames` or more."""
        ...

    def encode(self, frames: Tensor) -> Tensor:
        """Frames -> latents."""
        ...

    def decode(self, latents: Tensor) -> Tensor:
        """Latents -> frames, clamped to [0,1]."""
        ...

    def embed(self, prompts: list[str]) -> Tensor:
        """Texts of any length -> [B,S,D]."""
        ...

    def velocity(self, latents: Tensor, tau: float | Tensor, context: Context) -> Tensor:
        """The velocity at flow times tau in [0,1] (a number or [B]), 0 where the context holds latents."""
        ...


class EmbeddedVideo:
    """The prior that ships with the package (or any other in its format): frames coded one by one, bodies known.

    Args:
        components: from `load_components`.
    """

    size = HEIGHT, WIDTH
    reads_bodies = True
    holds_first_frame = False  # it holds any token

    def __init__(self, components: Components) -> None:
        self.components = components

    def clip_frames(self, frames: int) -> int:
        """See `VideoModel`: any number will do."""
        return frames

    def encode(self, frames: Tensor) -> Tensor:
        """See `VideoModel`."""
        vae = self.components.vae
        batch, _, count = frames.shape[:3]
        flat = vae.normalized(vae.encode(2 * frames.transpose(1, 2).flatten(0, 1) - 1))
        return flat.unflatten(0, (batch, count)).transpose(1, 2)

    def decode(self, latents: Tensor) -> Tensor:
        """See `VideoModel`."""
        vae = self.components.vae
        batch, _, count = latents.shape[:3]
        flat = vae.decode(vae.denormalized(latents.transpose(1, 2).flatten(0, 1)))
        return (0.5 * flat + 0.5).clamp(0, 1).unflatten(0, (batch, count)).transpose(1, 2)

    def embed(self, prompts: list[str]) -> Tensor:
        """See `VideoModel`."""
        return embed_ids(self.components.text_encoder, *token_ids(self.components.tokenizer, prompts))

    def velocity(self, latents: Tensor, tau: float | Tensor, context: Context) -> Tensor:
        """See `VideoModel`."""
        times = _times(tau, latents)
        network = self.components.transformer
        dtype = _input_dtype(network)
        stacked = transformer_input(latents, context, self.components.vae.cell_readout).to(dtype)
        steps = timesteps(times, latents, context.held)
        velocity = network(stacked, steps, context.text.to(dtype), return_dict=False)[0].to(latents)
        return velocity if context.held is None else hold(velocity, replace(context, known=torch.zeros_like(latents)))


class WanVideo:
    """Wan 2.2 as published: 5B (one timestep a token) or A14B (two experts).

    It has no channels for body maps or coarse latents. 5B was trained to go on from a first frame at timestep 0; A14B
    (text to video) holds nothing.

    Args:
        components: from `load_components`, with `AutoencoderKLWan`.
        max_tokens: of a prompt; Wan was trained with 512.
        height: pixels of the person images that it is asked for; they are half as wide.
    """

    reads_bodies = False

    def __init__(self, components: Components, max_tokens: int = 512, height: int = WAN_HEIGHT) -> None:
        self.components, self.max_tokens = components, max_tokens
        self.size = height, height // 2
        self.holds_first_frame = components.expand_timesteps

    def clip_frames(self, frames: int) -> int:
        """See `VideoModel`: 4k + 1."""
        return 4 * math.ceil((frames - 1) / 4) + 1

    def encode(self, frames: Tensor) -> Tensor:
        """See `VideoModel`; T is 4k + 1."""
        if frames.shape[2] % 4 != 1:
            raise ValueError(f"expected 4k+1 frames for Wan's autoencoder, got {frames.shape[2]}; repeat the last one")
        mean, std = self._statistics(frames)
        return (self.components.vae.encode(2 * frames - 1).latent_dist.mode() - mean) / std

    def decode(self, latents: Tensor) -> Tensor:
        """See `VideoModel`."""
        mean, std = self._statistics(latents)
        return (0.5 * self.components.vae.decode(latents * std + mean).sample + 0.5).clamp(0, 1)

    def embed(self, prompts: list[str]) -> Tensor:
        """See `VideoModel`."""
        ids, mask = token_ids(self.components.tokenizer, prompts, self.max_tokens)
        return embed_ids(self.components.text_encoder, ids, mask)

    def expert(self, tau: float) -> Any:
        """The transformer in charge at a flow time."""
        second, boundary = self.components.transformer_2, self.components.boundary
        return self.components.transformer if second is None or tau >= (boundary or 0.0) else second

    def velocity(self, latents: Tensor, tau: float | Tensor, context: Context) -> Tensor:
        """See `VideoModel`. Where experts differ within a batch, each clip goes to its own."""
        times = _times(tau, latents)
        held = context.held if self.components.expand_timesteps else None
        state = hold(latents, context)
        velocity = torch.empty_like(latents)
        for network in {id(n): n for n in (self.expert(float(t)) for t in times)}.values():
            rows = torch.tensor([self.expert(float(t)) is network for t in times])
            dtype = _input_dtype(network)
            steps = 1000 * times[rows]
            if self.components.expand_timesteps:
                steps = timesteps(times[rows], latents[rows], None if held is None else held[rows])
            text = context.text[rows].to(dtype)
            velocity[rows] = network(state[rows].to(dtype), steps, text, return_dict=False)[0].to(latents)
        return velocity if context.held is None else hold(velocity, replace(context, known=torch.zeros_like(latents)))

    def _statistics(self, like: Tensor) -> tuple[Tensor, Tensor]:
        config = self.components.vae.config
        shape = (1, -1, 1, 1, 1)
        return torch.tensor(config.latents_mean).to(like).view(shape), torch.tensor(config.latents_std).to(like).view(
            shape
        )


def load_video(folder: Path, dtype: torch.dtype = torch.float32) -> EmbeddedVideo | WanVideo:
    """The video model in a folder: the embedded prior or a published Wan pipeline, told apart by its autoencoder."""
    components = load_components(folder, dtype)
    if type(components.vae).__name__ == "FrameAutoencoder":
        return EmbeddedVideo(components)
    add_identity_token(components.tokenizer, components.text_encoder)
    return WanVideo(components)


def _input_dtype(network: Any) -> torch.dtype:
    """What a transformer takes. Its first parameters stay float32 whatever it was loaded as; its convolution tells."""
    dtype: torch.dtype = network.patch_embedding.weight.dtype
    return dtype


def _times(tau: float | Tensor, latents: Tensor) -> Tensor:
    """Flow times [B], float32."""
    times = torch.as_tensor(tau, dtype=torch.float32, device=latents.device)
    if bool((times < 0).any()) or bool((times > 1).any()):
        raise ValueError(f"expected flow times in [0,1], got {times.flatten()[:4].tolist()}")
    return times.expand(len(latents))
