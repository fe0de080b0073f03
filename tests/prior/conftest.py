"""Tiny priors in the real on-disk formats: the classes are diffusers' and transformers', only the sizes are small."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from ahoy_core.prior.autoencoder import FrameAutoencoder
from ahoy_core.prior.format import save_prior
from ahoy_core.prior.text import TEXT_WIDTH, build_text_encoder, build_tokenizer
from ahoy_core.prior.transformer import build_transformer
from ahoy_core.prior.video import VideoModel, load_video

WAN_CHANNELS = {"a14b": 16, "5b": 48}


@pytest.fixture(scope="session")
def embedded_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An untrained embedded prior of 12k parameters."""
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("embedded")
    vae = FrameAutoencoder(widths=(8, 8, 8), latents_mean=[0.1] * 16, latents_std=[1.5] * 16)
    tokenizer = build_tokenizer()
    save_prior(folder, build_transformer(24, 1, 2), vae, build_text_encoder(len(tokenizer)), tokenizer)
    return folder


@pytest.fixture
def embedded(embedded_folder: Path) -> VideoModel:
    return load_video(embedded_folder)


@pytest.fixture(scope="session")
def wan_folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Both published forms of Wan 2.2, saved by diffusers itself: A14B with two experts, 5B with one."""
    from diffusers import AutoencoderKLWan, UniPCMultistepScheduler, WanPipeline, WanTransformer3DModel

    torch.manual_seed(0)
    tokenizer = build_tokenizer()

    def transformer(channels: int) -> WanTransformer3DModel:
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
    plain = AutoencoderKLWan(z_dim=16, **small)
    residual = AutoencoderKLWan(
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
    scheduler = UniPCMultistepScheduler(prediction_type="flow_prediction", use_flow_sigmas=True, flow_shift=3.0)
    encoder = build_text_encoder(len(tokenizer))
    folders = {name: tmp_path_factory.mktemp(f"wan_{name}") for name in WAN_CHANNELS}
    WanPipeline(
        tokenizer, encoder, plain, scheduler, transformer(16), transformer(16), boundary_ratio=0.875
    ).save_pretrained(folders["a14b"])
    WanPipeline(tokenizer, encoder, residual, scheduler, transformer(48), None, expand_timesteps=True).save_pretrained(
        folders["5b"]
    )
    return folders
