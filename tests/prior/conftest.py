"""Tiny priors in the real on-disk formats: the classes are diffusers' and transformers', only the sizes are small."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from ahoy_core.prior.autoencoder import FrameAutoencoder
from ahoy_core.prior.format import save_prior
from ahoy_core.prior.text import build_text_encoder, build_tokenizer
from ahoy_core.prior.transformer import build_transformer
from ahoy_core.prior.video import VideoModel, load_video
from tests.prior.pipelines import WAN_CHANNELS, save_wan


@pytest.fixture(scope="session")
def embedded_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An untrained embedded prior of 12k parameters."""
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("embedded")
    vae = FrameAutoencoder(
        widths=(8, 8, 8), latents_mean=[0.1] * 16, latents_std=[1.5] * 16, cell_readout=[[0.2] * 17] * 12
    )
    tokenizer = build_tokenizer()
    save_prior(folder, build_transformer(24, 1, 2), vae, build_text_encoder(len(tokenizer)), tokenizer)
    return folder


@pytest.fixture
def embedded(embedded_folder: Path) -> VideoModel:
    return load_video(embedded_folder)


@pytest.fixture(scope="session")
def wan_folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Both published forms of Wan 2.2: A14B with two experts, 5B with one."""
    return {name: save_wan(tmp_path_factory.mktemp(f"wan_{name}"), name) for name in WAN_CHANNELS}
