"""The small transformer of the embedded prior: diffusers' own class, with more input channels."""

from __future__ import annotations

from typing import Any

from ahoy_core.prior.conditioning import INPUT_CHANNELS, LATENT_CHANNELS, PATCH
from ahoy_core.prior.text import TEXT_WIDTH


def build_transformer(width: int = 192, layers: int = 6, heads: int = 4) -> Any:
    """An untrained `WanTransformer3DModel` (velocity = noise - data, timesteps 1000 tau, one per token)."""
    from diffusers import WanTransformer3DModel

    return WanTransformer3DModel(
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
