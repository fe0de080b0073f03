"""Role "inpaint" by FLUX.1 Fill (Black Forest Labs), through diffusers: mask 1 is repainted, the rest stays."""

from __future__ import annotations

from typing import Any, Final

import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor
from torch.nn.functional import interpolate

from ahoy_core.models.adapter import Adapter, Fill
from ahoy_core.models.checkpoint import device_of, dtype_of, pretrained, short
from ahoy_core.models.errors import CheckpointError
from ahoy_core.models.offline import stay_offline
from ahoy_core.models.shelf import is_filling

PROMPT: Final = "a full-body photo of a person, plain grey background"


class FluxOptions(BaseModel):
    """Knobs.

    Attributes:
        steps: of the sampler.
        guidance: of the distilled guidance; 30 is the makers' choice for Fill.
        side: longer side in pixels that the model works at, a multiple of 16.
        tokens: of the prompt.
        offload: keep on the GPU only what is at work (needs accelerate); for cards that do not hold it all.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    steps: int = Field(default=50, ge=1)
    guidance: float = Field(default=30.0, ge=0)
    side: int = Field(default=1024, ge=16, multiple_of=16)
    tokens: int = Field(default=512, ge=1, le=512)
    offload: bool = False


class FluxFill:
    """FLUX Fill as the role "inpaint".

    Args:
        pipeline: `FluxFillPipeline`.
        options: the knobs.
    """

    name = "FLUX.1 Fill"

    def __init__(self, pipeline: Any, options: FluxOptions) -> None:
        self.pipeline, self.options = pipeline, options
        # The pipeline's patches: pixels a side of one token.
        self._multiple = 2 * pipeline.vae_scale_factor

    @torch.no_grad()
    def __call__(self, image: Tensor, mask: Tensor, prompt: str = "", seed: int = 0) -> Tensor:
        """Fill.

        Args:
            image: [3,H,W] in [0,1].
            mask: [1,H,W], 1 = fill; soft edges blend.
            prompt: what is there; a plain one by default.
            seed: of the noise.

        Returns:
            [3,H,W] in [0,1], equal to `image` where the mask is 0.

        Raises:
            ValueError: for shapes that are no image and its mask.
        """
        if image.ndim != 3 or len(image) != 3 or mask.shape != (1, *image.shape[1:]):
            raise ValueError(f"expected image [3,H,W] and mask [1,H,W], got {tuple(image.shape)}, {tuple(mask.shape)}")
        if not bool((mask > 0).any()):
            return image.clone()
        height, width = self._size(image.shape[1], image.shape[2])
        small, hole = (_resized(x.float(), height, width) for x in (image, mask))
        made = self.pipeline(
            prompt=prompt or PROMPT,
            image=small[None].clamp(0, 1),
            mask_image=(hole[None] > 1e-3).float(),
            height=height,
            width=width,
            num_inference_steps=self.options.steps,
            guidance_scale=self.options.guidance,
            max_sequence_length=self.options.tokens,
            generator=torch.Generator().manual_seed(seed),
            output_type="pt",
        ).images[0]
        filled = _resized(made.float().cpu(), image.shape[1], image.shape[2]).clamp(0, 1)
        return image * (1 - mask) + filled.to(image) * mask

    def _size(self, height: int, width: int) -> tuple[int, int]:
        scale = self.options.side / max(height, width)
        tall, wide = (max(1, round(n * scale / self._multiple)) * self._multiple for n in (height, width))
        return tall, wide


def _resized(x: Tensor, height: int, width: int) -> Tensor:
    return interpolate(x[None], (height, width), mode="bilinear", antialias=True, align_corners=False)[0]


def load_flux_fill(fill: Fill, adapter: Adapter) -> FluxFill:
    """Read FLUX.1 Fill from a folder in diffusers' layout.

    Each part is read on its own, so that missing weights are an error and not random numbers.

    Args:
        fill: `path` is the folder; `options`: `FluxOptions`.
        adapter: its declaration.

    Raises:
        CheckpointError: a part is missing, truncated, or another model's.
    """
    assert fill.path is not None
    stay_offline()
    from diffusers import AutoencoderKL, FlowMatchEulerDiscreteScheduler, FluxFillPipeline, FluxTransformer2DModel
    from transformers import AutoTokenizer, CLIPTextModel, T5EncoderModel

    options, dtype, folder = FluxOptions(**fill.options), dtype_of(fill, adapter), fill.path
    placed = fill.model_copy(update={"device": "cpu"}) if options.offload else fill
    transformer = pretrained(FluxTransformer2DModel, folder / "transformer", placed, adapter, torch_dtype=dtype)
    channels = transformer.config.in_channels
    vae = pretrained(AutoencoderKL, folder / "vae", placed, adapter, torch_dtype=dtype)
    # Packed latents, packed latents of what stays, and the mask in the autoencoder's patches.
    expected = 8 * vae.config.latent_channels + 4 * (2 ** (len(vae.config.block_out_channels) - 1)) ** 2
    if channels != expected:
        raise CheckpointError(
            f"{adapter.label}: {folder} takes {channels} channels instead of {expected}: it is FLUX, but not Fill; "
            f"{adapter.how_to_get()}"
        )
    try:
        tokenizers = [AutoTokenizer.from_pretrained(folder / n, local_files_only=True) for n in _TOKENIZERS]
        scheduler = FlowMatchEulerDiscreteScheduler.from_pretrained(folder / "scheduler", local_files_only=True)
    except (OSError, ValueError) as error:
        raise CheckpointError(
            f"{adapter.label}: {folder} has no tokenizer or scheduler that can be read ({short(error)}); "
            f"{adapter.how_to_get()}"
        ) from error
    pipeline = FluxFillPipeline(
        scheduler=scheduler,
        vae=vae,
        text_encoder=pretrained(CLIPTextModel, folder / "text_encoder", placed, adapter, dtype=dtype),
        tokenizer=tokenizers[0],
        text_encoder_2=pretrained(T5EncoderModel, folder / "text_encoder_2", placed, adapter, dtype=dtype),
        tokenizer_2=tokenizers[1],
        transformer=transformer,
    )
    pipeline.set_progress_bar_config(disable=True)
    if options.offload and not is_filling():
        pipeline.enable_model_cpu_offload(device=device_of(fill))
    return FluxFill(pipeline, options)


_TOKENIZERS: Final = ("tokenizer", "tokenizer_2")
