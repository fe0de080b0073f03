"""The prior on disk: the folder layout of a diffusers Wan pipeline, whatever the size of what is in it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import torch

from ahoy_core.prior.autoencoder import FrameAutoencoder

PIPELINE: Final = "WanPipeline"
_SCHEDULER: Final = {"num_train_timesteps": 1000, "shift": 1.0}


class PriorFormatError(ValueError):
    """A folder is no prior that can be loaded. The text says what was expected, what was found, and what to do."""


@dataclass(frozen=True)
class Components:
    """What a prior is made of.

    Attributes:
        transformer: `WanTransformer3DModel` (of the high noise levels where there are two).
        transformer_2: the expert of the low noise levels (A14B), or None.
        vae: `FrameAutoencoder` or `AutoencoderKLWan`.
        text_encoder: of transformers.
        tokenizer: of transformers.
        boundary: tau from which `transformer` is used instead of `transformer_2` (`boundary_ratio`).
        expand_timesteps: one timestep a token (5B and the embedded prior).
    """

    transformer: Any
    transformer_2: Any
    vae: Any
    text_encoder: Any
    tokenizer: Any
    boundary: float | None
    expand_timesteps: bool


def save_autoencoder(folder: Path, vae: FrameAutoencoder) -> None:
    """Writes an autoencoder, without the path that it was read from, which diffusers would note down."""
    vae.save_pretrained(folder)
    config = folder / "config.json"
    kept = {name: value for name, value in json.loads(config.read_text()).items() if name != "_name_or_path"}
    config.write_text(json.dumps(kept, indent=2) + "\n")


def save_prior(folder: Path, transformer: Any, vae: FrameAutoencoder, text_encoder: Any, tokenizer: Any) -> None:
    """Writes an embedded prior: one transformer, one timestep a token.

    Args:
        folder: made if it is not there.
        transformer: `WanTransformer3DModel`.
        vae: with latent statistics.
        text_encoder: `UMT5EncoderModel`.
        tokenizer: its tokenizer.
    """
    from diffusers import FlowMatchEulerDiscreteScheduler

    folder.mkdir(parents=True, exist_ok=True)
    transformer.save_pretrained(folder / "transformer")
    save_autoencoder(folder / "vae", vae)
    text_encoder.save_pretrained(folder / "text_encoder")
    # A tokenizer notes down how its last call padded and cut; that belongs to the call.
    tokenizer.backend_tokenizer.no_padding()
    tokenizer.backend_tokenizer.no_truncation()
    tokenizer.save_pretrained(folder / "tokenizer")
    FlowMatchEulerDiscreteScheduler(**_SCHEDULER).save_pretrained(folder / "scheduler")
    index = {
        "_class_name": PIPELINE,
        "boundary_ratio": None,
        "expand_timesteps": True,
        "scheduler": ["diffusers", "FlowMatchEulerDiscreteScheduler"],
        "text_encoder": ["transformers", type(text_encoder).__name__],
        "tokenizer": ["transformers", type(tokenizer).__name__],
        "transformer": ["diffusers", "WanTransformer3DModel"],
        "transformer_2": [None, None],
        "vae": [FrameAutoencoder.__module__, FrameAutoencoder.__name__],
    }
    (folder / "model_index.json").write_text(json.dumps(index, indent=2) + "\n")


def load_components(folder: Path, dtype: torch.dtype = torch.float32) -> Components:
    """Loads a prior from a folder, never from a network.

    Args:
        folder: of a Wan pipeline: Wan 2.2 5B or A14B as published, or the embedded prior.
        dtype: of transformer and text encoder; the autoencoder is always float32.

    Raises:
        PriorFormatError: when the folder is something else.
    """
    index = read_index(folder)
    options = {"torch_dtype": dtype, "local_files_only": True}
    from diffusers import WanTransformer3DModel

    second = None
    with _without_bars():
        if index.get("transformer_2", [None, None])[1] is not None:
            second = WanTransformer3DModel.from_pretrained(folder, subfolder="transformer_2", **options).eval()
        return Components(
            transformer=WanTransformer3DModel.from_pretrained(folder, subfolder="transformer", **options).eval(),
            transformer_2=second,
            vae=_vae(folder, index).eval(),
            text_encoder=_text_encoder(folder, dtype),
            tokenizer=_tokenizer(folder),
            boundary=index.get("boundary_ratio"),
            expand_timesteps=bool(index.get("expand_timesteps", False)),
        )


@contextmanager
def _without_bars() -> Iterator[None]:
    """Loads without the library's progress bar, which would be drawn over a run's own."""
    from transformers.utils import logging

    shown = logging.is_progress_bar_enabled()
    logging.disable_progress_bar()
    try:
        yield
    finally:
        if shown:
            logging.enable_progress_bar()


def read_index(folder: Path) -> dict[str, Any]:
    """The `model_index.json` of a Wan pipeline's folder.

    Raises:
        PriorFormatError: when the folder is something else.
    """
    path = folder / "model_index.json"
    if not path.is_file():
        raise PriorFormatError(
            f"expected a folder with model_index.json, got {str(folder)!r}; give a Wan pipeline's folder"
        )
    index: dict[str, Any] = json.loads(path.read_text())
    if index.get("_class_name") != PIPELINE:
        raise PriorFormatError(f"expected a {PIPELINE}, got {index.get('_class_name')!r} in {str(folder)!r}")
    return index


def _vae(folder: Path, index: dict[str, Any]) -> Any:
    if index["vae"][1] == FrameAutoencoder.__name__:
        return FrameAutoencoder.from_pretrained(folder, subfolder="vae", local_files_only=True)
    from diffusers import AutoencoderKLWan

    return AutoencoderKLWan.from_pretrained(folder, subfolder="vae", torch_dtype=torch.float32, local_files_only=True)


def _text_encoder(folder: Path, dtype: torch.dtype) -> Any:
    from transformers import UMT5EncoderModel

    return UMT5EncoderModel.from_pretrained(folder / "text_encoder", dtype=dtype, local_files_only=True).eval()


def _tokenizer(folder: Path) -> Any:
    from transformers import AutoTokenizer

    return AutoTokenizer.from_pretrained(folder / "tokenizer", local_files_only=True)
