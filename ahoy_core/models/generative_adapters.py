"""Declarations of what can fill the roles that make pictures: inpaint, views, video, face."""

from __future__ import annotations

from typing import Final

from ahoy_core.models.adapter import Adapter, ExpectedFile

_DIFFUSION = ("diffusers", "transformers")
_WAN_FILES = (
    ExpectedFile("model_index.json", "of WanPipeline"),
    ExpectedFile("transformer/*.safetensors", "the transformer"),
    ExpectedFile("vae/*.safetensors", "the autoencoder"),
    ExpectedFile("text_encoder/*.safetensors", "umT5-XXL"),
    ExpectedFile("tokenizer/tokenizer.json|tokenizer/spiece.model", "its tokenizer"),
)

GENERATIVE: Final = (
    Adapter(
        role="inpaint",
        name="flux-fill",
        title="FLUX.1 Fill [dev]",
        licence="FLUX.1 [dev] Non-Commercial License",
        commercial="no",
        licence_at="Hugging Face, black-forest-labs/FLUX.1-Fill-dev, LICENSE.md",
        source="Hugging Face, black-forest-labs/FLUX.1-Fill-dev, after accepting its terms: the whole folder",
        files=(
            ExpectedFile("model_index.json", "of FluxFillPipeline"),
            ExpectedFile("transformer/*.safetensors", "the transformer, 12 billion parameters"),
            ExpectedFile("vae/*.safetensors", "the autoencoder"),
            ExpectedFile("text_encoder/*.safetensors", "CLIP"),
            ExpectedFile("text_encoder_2/*.safetensors", "T5-XXL"),
            ExpectedFile("tokenizer/tokenizer.json|tokenizer/vocab.json", "tokenizer of CLIP"),
            ExpectedFile("tokenizer_2/tokenizer.json|tokenizer_2/spiece.model", "tokenizer of T5"),
            ExpectedFile("scheduler/scheduler_config.json", "the scheduler"),
        ),
        parameters=16.9,
        dtype="bfloat16",
        device="cuda",
        extra="flux",
        packages=_DIFFUSION,
        load="ahoy_core.models.flux_fill:load_flux_fill",
    ),
    Adapter(
        role="views",
        name="synchuman",
        title="SyncHuman (external command)",
        licence="its repository's terms, and those of the models it is built on",
        commercial="conditions",
        licence_at="the LICENSE of the SyncHuman repository that you run",
        source="the SyncHuman repository in an environment of its own; docs/models.md has the command",
        files=(),
        device="cuda",
        is_command=True,
        load="ahoy_core.models.synchuman:load_synchuman",
    ),
    Adapter(
        role="face",
        name="cap4d",
        title="CAP4D (external command)",
        licence="its repository's terms; FLAME's licence besides",
        commercial="conditions",
        licence_at="github.com/felixtaubner/cap4d and flame.is.tue.mpg.de/modellicense.html",
        source="github.com/felixtaubner/cap4d in an environment of its own; docs/models.md has the command",
        files=(),
        device="cuda",
        is_command=True,
        load="ahoy_core.models.cap4d:load_cap4d",
    ),
    Adapter(
        role="video",
        name="wan2.2-5b",
        title="Wan 2.2 TI2V 5B",
        licence="Apache-2.0",
        commercial="yes",
        licence_at="github.com/Wan-Video/Wan2.2/blob/main/LICENSE.txt",
        source="Hugging Face, Wan-AI/Wan2.2-TI2V-5B-Diffusers: the whole folder",
        files=_WAN_FILES,
        parameters=11.4,
        dtype="bfloat16",
        device="cuda",
        extra="wan",
        packages=(*_DIFFUSION, "peft"),
        load="ahoy_core.models.wan:load_5b",
    ),
    Adapter(
        role="video",
        name="wan2.2-a14b",
        title="Wan 2.2 T2V A14B",
        licence="Apache-2.0",
        commercial="yes",
        licence_at="github.com/Wan-Video/Wan2.2/blob/main/LICENSE.txt",
        source="Hugging Face, Wan-AI/Wan2.2-T2V-A14B-Diffusers: the whole folder",
        files=(*_WAN_FILES, ExpectedFile("transformer_2/*.safetensors", "the expert of the low noise levels")),
        parameters=34.3,
        dtype="bfloat16",
        device="cuda",
        extra="wan",
        packages=(*_DIFFUSION, "peft"),
        load="ahoy_core.models.wan:load_a14b",
    ),
)
