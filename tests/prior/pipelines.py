"""Tiny Wan 2.2 pipelines, saved by diffusers itself in the forms in which they are published."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from ahoy_core.prior.text import TEXT_WIDTH, build_text_encoder, build_tokenizer

WAN_CHANNELS = {"a14b": 16, "5b": 48}


def save_wan(folder: Path, form: str, tokenizer: Any = None) -> Path:
    """Write "5b" (residual autoencoder, one timestep a token) or "a14b" (two experts).

    Args:
        folder: where to.
        form: which one.
        tokenizer: instead of the embedded prior's.
    """
    from diffusers import AutoencoderKLWan, UniPCMultistepScheduler, WanPipeline, WanTransformer3DModel

    torch.manual_seed(0)
    channels = WAN_CHANNELS[form]

    def transformer() -> WanTransformer3DModel:
        return WanTransformer3DModel(
            patch_size=(1, 2, 2),
            num_attention_heads=2,
            attention_head_dim=12,
            in_channels=channels,
            out_channels=channels,
            text_dim=TEXT_WIDTH,
            freq_dim=32,
            ffn_dim=32,
            num_layers=1,
            rope_max_seq_len=32,
        )

    small = {"base_dim": 8, "dim_mult": [1, 1, 2, 2], "num_res_blocks": 1, "temperal_downsample": [False, True, True]}
    tokenizer = tokenizer or build_tokenizer()
    encoder = build_text_encoder(len(tokenizer))
    scheduler = UniPCMultistepScheduler(prediction_type="flow_prediction", use_flow_sigmas=True, flow_shift=3.0)
    if form == "a14b":
        vae = AutoencoderKLWan(z_dim=16, **small)
        first, second = transformer(), transformer()
        pipeline = WanPipeline(tokenizer, encoder, vae, scheduler, first, second, boundary_ratio=0.875)
    else:
        vae = AutoencoderKLWan(
            z_dim=48,
            decoder_base_dim=8,
            is_residual=True,
            in_channels=12,
            out_channels=12,
            patch_size=2,
            scale_factor_spatial=16,
            latents_mean=[0.0] * 48,
            latents_std=[1.0] * 48,
            **small,
        )
        pipeline = WanPipeline(tokenizer, encoder, vae, scheduler, transformer(), None, expand_timesteps=True)
    pipeline.save_pretrained(folder)
    return folder
