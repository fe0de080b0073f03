"""The small transformer of the embedded prior: diffusers' own class, with more input channels."""

from __future__ import annotations

from typing import Any

import torch

from ahoy_core.prior.conditioning import COARSE_START, INPUT_CHANNELS, LATENT_CHANNELS, PATCH
from ahoy_core.prior.text import TEXT_WIDTH


def build_transformer(width: int = 192, layers: int = 6, heads: int = 4) -> Any:
    """An untrained `WanTransformer3DModel` (velocity = noise - data, timesteps 1000 tau, one per token).

    Args:
        width: channels; from 2 * LATENT_CHANNELS * PATCH**2 on, training starts where pure noise becomes the coarse
            latents (`_pass_coarse_through`).
        layers: blocks.
        heads: of attention; their size, width / heads, is even.
    """
    from diffusers import WanTransformer3DModel

    transformer = WanTransformer3DModel(
        patch_size=(1, PATCH, PATCH),
        num_attention_heads=heads,
        attention_head_dim=width // heads,
        in_channels=INPUT_CHANNELS,
        out_channels=LATENT_CHANNELS,
        text_dim=TEXT_WIDTH,
        freq_dim=128,
        ffn_dim=3 * width,
        num_layers=layers,
        cross_attn_norm=True,
        qk_norm="rms_norm_across_heads",
        rope_max_seq_len=64,
    )
    if width >= 2 * LATENT_CHANNELS * PATCH**2:
        _pass_coarse_through(transformer)
    return transformer


@torch.no_grad()
def _pass_coarse_through(transformer: Any) -> None:
    """Starts at velocity = state - coarse latents, which is right at pure noise if the coarse video were the truth.

    A hundred CPU-seconds of training then go into what the coarse video lacks, not into copying it. The blocks add
    nothing at first; the last normalisation rescales a little, which the first steps correct.
    """
    embed, out = transformer.patch_embedding, transformer.proj_out
    embed.weight.mul_(0.5)
    places = [(c, dy, dx) for c in range(LATENT_CHANNELS) for dy in range(PATCH) for dx in range(PATCH)]
    embed.weight[: 2 * len(places)] = 0
    embed.bias[: 2 * len(places)] = 0
    out.weight.mul_(0.1)
    for k, (c, dy, dx) in enumerate(places):
        embed.weight[k, c, 0, dy, dx] = 1
        embed.weight[len(places) + k, COARSE_START + c, 0, dy, dx] = 1
        row = (dy * PATCH + dx) * LATENT_CHANNELS + c
        out.weight[row] = 0
        out.weight[row, k] = 1
        out.weight[row, len(places) + k] = -1
    out.bias.zero_()
    # The modulation before the last projection: neither shift nor scale at the start.
    transformer.scale_shift_table.zero_()
    for block in transformer.blocks:
        for last in (block.attn1.to_out[0], block.attn2.to_out[0], block.ffn.net[2]):
            last.weight.zero_()
            last.bias.zero_()
