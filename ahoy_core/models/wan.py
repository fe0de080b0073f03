"""Role "video" by Wan 2.2 as published (5B and A14B), on a GPU: half-precision weights, float32 states, offloading.

`ahoy_core.prior.video.WanVideo` is the model; this puts it on a device. Latents and texts are handed in and out on the
CPU in float32, so that solvers need not know where the networks are.
"""

from __future__ import annotations

from dataclasses import fields, replace

import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor, nn

from ahoy_core.models.adapter import Adapter, Fill
from ahoy_core.models.checkpoint import device_of, dtype_of, pretrained, short
from ahoy_core.models.errors import CheckpointError
from ahoy_core.models.offline import stay_offline
from ahoy_core.prior.conditioning import Context
from ahoy_core.prior.format import Components, PriorFormatError, read_index
from ahoy_core.prior.text import add_identity_token, embed_ids, token_ids
from ahoy_core.prior.video import WAN_HEIGHT, WanVideo


class WanOptions(BaseModel):
    """Knobs.

    Attributes:
        height: pixels of the person images that it is asked for, a multiple of 64; they are half as wide. Wan was
            trained at 480 x 832 and (5B) 704 x 1280.
        offload: keep one network on the GPU at a time, the others in main memory.
        tiling: let the autoencoder work in tiles: less memory, a little slower.
        max_tokens: of a prompt; Wan was trained with 512.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    height: int = Field(default=WAN_HEIGHT, ge=64, multiple_of=64)
    offload: bool = False
    tiling: bool = False
    max_tokens: int = Field(default=512, ge=1, le=512)


class PlacedWan(WanVideo):
    """Wan on a device.

    Args:
        components: as loaded; moved when they are used if `options.offload`.
        device: where the networks work.
        options: the knobs.
    """

    def __init__(self, components: Components, device: torch.device, options: WanOptions) -> None:
        super().__init__(components, options.max_tokens, options.height)
        self.device, self.options = device, options

    def encode(self, frames: Tensor) -> Tensor:
        """See `VideoModel`; T is 4k + 1."""
        self._bring(self.components.vae)
        return super().encode(frames.to(self.device, torch.float32)).cpu()

    def decode(self, latents: Tensor) -> Tensor:
        """See `VideoModel`."""
        self._bring(self.components.vae)
        return super().decode(latents.to(self.device, torch.float32)).cpu()

    def embed(self, prompts: list[str]) -> Tensor:
        """See `VideoModel`."""
        self._bring(self.components.text_encoder)
        ids, mask = token_ids(self.components.tokenizer, prompts, self.max_tokens)
        return embed_ids(self.components.text_encoder, ids.to(self.device), mask.to(self.device)).float().cpu()

    def velocity(self, latents: Tensor, tau: float | Tensor, context: Context) -> Tensor:
        """See `VideoModel`. Rows of one expert go together, so that each expert is brought once."""
        times = torch.as_tensor(tau, dtype=torch.float32).cpu().expand(len(latents))
        velocity = torch.empty_like(latents)
        for network in {id(n): n for n in (self.expert(float(t)) for t in times)}.values():
            rows = torch.tensor([self.expert(float(t)) is network for t in times])
            self._bring(network)
            chosen = _placed(context, rows, self.device)
            moved = latents[rows.to(latents.device)].to(self.device, torch.float32)
            velocity[rows.to(latents.device)] = super().velocity(moved, times[rows].to(self.device), chosen).to(latents)
        return velocity

    def _bring(self, network: nn.Module) -> None:
        """Put a network on the device; with offloading, the others off it first."""
        if not self.options.offload:
            return
        parts = self.components
        for other in (parts.transformer, parts.transformer_2, parts.vae, parts.text_encoder):
            if other is not None and other is not network:
                other.to("cpu")
        network.to(self.device)


def _placed(context: Context, rows: Tensor, device: torch.device) -> Context:
    """Some rows of a context on a device."""
    values = {f.name: getattr(context, f.name) for f in fields(context)}
    return replace(context, **{n: v[rows.to(v.device)].to(device) for n, v in values.items() if v is not None})


def load_5b(fill: Fill, adapter: Adapter) -> PlacedWan:
    """Wan 2.2 TI2V 5B; see `load_wan`."""
    return load_wan(fill, adapter, experts=1)


def load_a14b(fill: Fill, adapter: Adapter) -> PlacedWan:
    """Wan 2.2 T2V A14B; see `load_wan`."""
    return load_wan(fill, adapter, experts=2)


def load_wan(fill: Fill, adapter: Adapter, experts: int) -> PlacedWan:
    """Read a Wan pipeline, every part complete or refused.

    Args:
        fill: `path` is the folder in diffusers' layout; `options`: `WanOptions`.
        adapter: its declaration.
        experts: that it has to have.

    Raises:
        CheckpointError: another pipeline, another number of experts, or a part without some of its weights.
    """
    assert fill.path is not None
    stay_offline()
    from diffusers import AutoencoderKLWan, WanTransformer3DModel
    from transformers import AutoTokenizer, UMT5EncoderModel

    folder, options, dtype = fill.path, WanOptions(**fill.options), dtype_of(fill, adapter)
    try:
        index = read_index(folder)
        tokenizer = AutoTokenizer.from_pretrained(folder / "tokenizer", local_files_only=True)
    except (PriorFormatError, OSError, ValueError) as error:
        raise CheckpointError(f"{adapter.label}: {short(error)}; {adapter.how_to_get()}") from error
    names = ["transformer"] + (["transformer_2"] if index.get("transformer_2", [None, None])[1] is not None else [])
    if len(names) != experts or index["vae"][1] != AutoencoderKLWan.__name__:
        raise CheckpointError(
            f"{adapter.label}: {folder} has {len(names)} experts and {index['vae'][1]} instead of {experts} and "
            f"{AutoencoderKLWan.__name__}: another model; {adapter.how_to_get()}"
        )
    placed = fill.model_copy(update={"device": "cpu"}) if options.offload else fill
    networks = [pretrained(WanTransformer3DModel, folder / n, placed, adapter, torch_dtype=dtype) for n in names]
    vae = pretrained(AutoencoderKLWan, folder / "vae", placed, adapter, torch_dtype=torch.float32)
    if options.tiling:
        vae.enable_tiling()
    components = Components(
        transformer=networks[0],
        transformer_2=networks[1] if experts == 2 else None,
        vae=vae,
        text_encoder=pretrained(UMT5EncoderModel, folder / "text_encoder", placed, adapter, dtype=dtype),
        tokenizer=tokenizer,
        boundary=index.get("boundary_ratio"),
        expand_timesteps=bool(index.get("expand_timesteps", False)),
    )
    add_identity_token(components.tokenizer, components.text_encoder)
    return PlacedWan(components, device_of(fill), options)
