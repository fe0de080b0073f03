"""What the prior's transformer sees beside noisy latents: body, azimuth, coarse latents, what is held, its colours."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import torch
from torch import Tensor, nn

from ahoy_core.prior.bodymaps import CELL, CHANNELS
from ahoy_core.prior.carry import CARRIED_CHANNELS, FACTOR, carried_colours

PATCH: Final = 2  # latents a token, along each axis
LATENT_CHANNELS: Final = 16
_BODY: Final = CHANNELS * (FACTOR // CELL) ** 2  # 28: the maps' cells of one latent
# Azimuth (sine, cosine), body known, place in the picture (x, y), coarse known, coverage.
_FLAGS: Final = 7
COARSE_START: Final = LATENT_CHANNELS + _BODY + 3
"""First channel of the coarse latents in the transformer's input."""
INPUT_CHANNELS: Final = LATENT_CHANNELS + _BODY + LATENT_CHANNELS + _FLAGS + CARRIED_CHANNELS


@dataclass(frozen=True)
class Context:
    """What a velocity is conditioned on, for B videos of T latent frames of h x w.

    Attributes:
        text: [B,S,D] embeddings.
        known: [B,C,T,h,w] clean latents, or None.
        held: [B,T,h/2,w/2] bool, tokens that keep `known` at timestep 0; None for none.
        body: [B,T,7,2h,2w] `body_maps`, 0 for a clip whose body is not known, or None.
        azimuth: [B,T] radians; needed with `body`.
        coarse: [B,C,T,h,w] latents of the coarse rendering, 0 for a clip that has none, or None.
        coverage: [B,T,h,w] in [0,1], observed share of the coarse rendering; needed with `coarse`.
    """

    text: Tensor
    known: Tensor | None = None
    held: Tensor | None = None
    body: Tensor | None = None
    azimuth: Tensor | None = None
    coarse: Tensor | None = None
    coverage: Tensor | None = None

    def __post_init__(self) -> None:
        if (self.known is None) != (self.held is None):
            raise ValueError("expected known latents together with held tokens, got one of the two")
        if (self.body is None) != (self.azimuth is None):
            raise ValueError("expected body maps together with azimuths, got one of the two")
        if (self.coarse is None) != (self.coverage is None):
            raise ValueError("expected coarse latents together with their coverage, got one of the two")

    def neutral(self, text: Tensor) -> Context:
        """The same without what identifies the subject: other text, nothing held, no coarse latents."""
        return replace(self, text=text, known=None, held=None, coarse=None, coverage=None)


def held_latents(held: Tensor) -> Tensor:
    """Held tokens [B,T,h/2,w/2] -> mask [B,1,T,h,w] over latents."""
    return held.repeat_interleave(PATCH, -1).repeat_interleave(PATCH, -2)[:, None]


def hold(latents: Tensor, context: Context) -> Tensor:
    """Latents [B,C,T,h,w] with the held ones put in."""
    if context.known is None or context.held is None:
        return latents
    return torch.where(held_latents(context.held), context.known, latents)


def timesteps(tau: Tensor, latents: Tensor, held: Tensor | None) -> Tensor:
    """Timesteps [B,T*h/2*w/2] of all tokens for flow times tau [B] in [0,1]: 1000 tau, and 0 where held."""
    batch, _, frames, height, width = latents.shape
    grid = tau.reshape(batch, 1, 1, 1).expand(batch, frames, height // PATCH, width // PATCH)
    if held is not None:
        grid = grid * ~held
    return 1000 * grid.flatten(1)


def transformer_input(latents: Tensor, context: Context, readout: Tensor) -> Tensor:
    """Stacks latents [B,16,T,h,w] and the context to the transformer's input [B,INPUT_CHANNELS,T,h,w].

    Args:
        latents: noisy ones.
        context: what is known.
        readout: [12,17] of the autoencoder, by which colours are read off held latents (`cell_colours`).

    Raises:
        ValueError: when a part of the context has another size.
    """
    batch, _, frames, height, width = latents.shape
    flags = latents.new_zeros(batch, 4, frames, height, width)
    flags[:, 0] = torch.linspace(-1, 1, width, dtype=latents.dtype, device=latents.device)
    flags[:, 1] = torch.linspace(-1, 1, height, dtype=latents.dtype, device=latents.device)[:, None]
    told = latents.new_zeros(batch, CARRIED_CHANNELS, frames, height, width)
    coarse = torch.zeros_like(latents)
    if context.body is not None and context.known is not None and context.held is not None:
        told = carried_colours(context.known, context.held, context.body, readout).to(latents)
    if context.coarse is not None and context.coverage is not None:
        given = context.coarse.flatten(1).any(1).view(-1, 1, 1, 1, 1)
        coarse = context.coarse
        flags[:, 2] = given[:, 0]
        flags[:, 3] = context.coverage
    return torch.cat([hold(latents, context), _body_channels(latents, context), coarse, flags, told], 1)


def _body_channels(latents: Tensor, context: Context) -> Tensor:
    """Folded body maps, azimuth and whether a clip has them, [B,_BODY + 3,T,h,w]."""
    batch, _, frames, height, width = latents.shape
    if context.body is None or context.azimuth is None:
        return latents.new_zeros(batch, _BODY + 3, frames, height, width)
    if context.body.shape != (batch, frames, CHANNELS, 2 * height, 2 * width):
        raise ValueError(
            f"expected body maps {[batch, frames, CHANNELS, 2 * height, 2 * width]} for these latents, got "
            f"{list(context.body.shape)}; render them at the person image's size"
        )
    folded = nn.functional.pixel_unshuffle(context.body.to(latents), FACTOR // CELL).transpose(1, 2)
    turn = context.azimuth.to(latents)[:, None, :, None, None].expand(batch, 1, frames, height, width)
    given = context.body.flatten(1).any(1).view(-1, 1, 1, 1, 1).expand_as(turn).to(latents)
    return torch.cat([folded, turn.sin() * given, turn.cos() * given, given], 1)


def held_tokens(coverage: Tensor, mask: Tensor, threshold: float = 0.97) -> Tensor:
    """Which tokens a coverage allows to hold: all of their person observed, or no person in them.

    Args:
        coverage: [B,T,H,W] in [0,1], pixels of the person that were observed.
        mask: [B,T,H,W] in [0,1], pixels of the person.
        threshold: observed share of a token's person from which it is held.

    Returns:
        [B,T,H/16,W/16] bool.
    """
    size = FACTOR * PATCH
    seen = nn.functional.avg_pool2d(torch.minimum(coverage, mask), size)
    there = nn.functional.avg_pool2d(mask, size)
    return seen >= threshold * there - 1e-6
