"""The video role: the embedded prior and both published forms of Wan, loaded from real folders, offline."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from ahoy_core.prior.conditioning import Context, held_latents, hold, timesteps, transformer_input
from ahoy_core.prior.format import PriorFormatError, save_prior
from ahoy_core.prior.text import IDENTITY_PROMPT, MAX_TOKENS
from ahoy_core.prior.video import EmbeddedVideo, VideoModel, WanVideo, load_video


def context(video: VideoModel, batch: int = 2, frames: int = 3, prompt: str = "a person") -> Context:
    generator = torch.Generator().manual_seed(3)
    return Context(
        text=video.embed([prompt] * batch),
        known=torch.randn(batch, 16, frames, 4, 4, generator=generator),
        held=torch.zeros(batch, frames, 2, 2, dtype=torch.bool),
        body=torch.rand(batch, frames, 7, 8, 8, generator=generator),
        azimuth=torch.rand(batch, frames, generator=generator),
        coarse=torch.randn(batch, 16, frames, 4, 4, generator=generator),
        coverage=torch.rand(batch, frames, 4, 4, generator=generator),
    )


def latents(batch: int = 2, channels: int = 16, frames: int = 3) -> torch.Tensor:
    return torch.randn(batch, channels, frames, 4, 4, generator=torch.Generator().manual_seed(4))


def test_the_folder_is_a_diffusers_pipeline(embedded_folder: Path) -> None:
    index = json.loads((embedded_folder / "model_index.json").read_text())
    assert index["_class_name"] == "WanPipeline" and index["transformer"] == ["diffusers", "WanTransformer3DModel"]
    for name in ("transformer", "vae", "text_encoder", "tokenizer", "scheduler"):
        assert any((embedded_folder / name).iterdir()), name
    assert not list(embedded_folder.rglob("*.bin")) and not list(embedded_folder.rglob("*.pt"))


def test_a_tokenizer_is_saved_without_what_its_last_call_did(embedded: EmbeddedVideo, tmp_path: Path) -> None:
    parts = embedded.components
    embedded.embed(["a person, red top"])
    save_prior(tmp_path, parts.transformer, parts.vae, parts.text_encoder, parts.tokenizer)
    saved = json.loads((tmp_path / "tokenizer" / "tokenizer.json").read_text())
    assert saved["padding"] is None and saved["truncation"] is None


def test_forms_are_told_apart(embedded_folder: Path, wan_folders: dict[str, Path]) -> None:
    assert isinstance(load_video(embedded_folder), EmbeddedVideo)
    five, fourteen = load_video(wan_folders["5b"]), load_video(wan_folders["a14b"])
    assert isinstance(five, WanVideo) and five.components.expand_timesteps and five.components.transformer_2 is None
    assert isinstance(fourteen, WanVideo) and fourteen.components.boundary == 0.875
    for video in (five, fourteen):
        assert isinstance(video, VideoModel)


def test_another_folder_is_refused(tmp_path: Path, embedded_folder: Path) -> None:
    with pytest.raises(PriorFormatError, match=r"model_index\.json"):
        load_video(tmp_path)
    (tmp_path / "model_index.json").write_text('{"_class_name": "FluxPipeline"}')
    with pytest.raises(PriorFormatError, match=r"WanPipeline.*FluxPipeline"):
        load_video(tmp_path)


@torch.no_grad()
def test_frames_are_coded_one_by_one(embedded: VideoModel) -> None:
    frames = torch.rand(2, 3, 3, 32, 16, generator=torch.Generator().manual_seed(0))
    coded = embedded.encode(frames)
    assert coded.shape == (2, 16, 3, 4, 2)
    torch.testing.assert_close(coded[:, :, 1:2], embedded.encode(frames[:, :, 1:2]), rtol=1e-5, atol=1e-5)
    restored = embedded.decode(coded)
    assert restored.shape == frames.shape and float(restored.min()) >= 0 and float(restored.max()) <= 1


@torch.no_grad()
@pytest.mark.parametrize("form", ["5b", "a14b"])
def test_wan_codes_and_flows(form: str, wan_folders: dict[str, Path]) -> None:
    video = load_video(wan_folders[form])
    coded = video.encode(torch.rand(1, 3, 5, 64, 64))
    assert coded.shape[:3] == (1, 48 if form == "5b" else 16, 2)
    assert video.decode(coded).shape == (1, 3, 5, 64, 64)
    velocity = video.velocity(coded, 0.5, Context(video.embed(["a person"])))
    assert velocity.shape == coded.shape and bool(torch.isfinite(velocity).all())
    with pytest.raises(ValueError, match=r"4k\+1 frames"):
        video.encode(torch.rand(1, 3, 4, 64, 64))


@torch.no_grad()
def test_experts_change_at_the_boundary_also_within_a_batch(wan_folders: dict[str, Path]) -> None:
    video = load_video(wan_folders["a14b"])
    z, text = latents(), video.embed(["a person"] * 2)
    times = torch.tensor([0.9, 0.5])
    mixed = video.velocity(z, times, Context(text))
    first, second = video.components.transformer, video.components.transformer_2
    for row, network in enumerate((first, second)):
        alone = network(z[row : row + 1], 1000 * times[row : row + 1], text[:1], return_dict=False)[0]
        torch.testing.assert_close(mixed[row : row + 1], alone, rtol=1e-5, atol=1e-5)
    assert video.expert(0.875) is first and video.expert(0.8749) is second


@torch.no_grad()
@pytest.mark.parametrize("tau", [0.0, 1.0])
def test_the_ends_of_the_flow_are_finite(embedded: VideoModel, tau: float) -> None:
    assert bool(torch.isfinite(embedded.velocity(latents(), tau, context(embedded))).all())


def test_times_outside_the_flow_are_refused(embedded: VideoModel) -> None:
    with pytest.raises(ValueError, match=r"flow times in \[0,1\]"):
        embedded.velocity(latents(), 1.5, context(embedded))


@torch.no_grad()
@pytest.mark.parametrize("prompt", ["", "x" * 10_000, "a person " * 1_250, IDENTITY_PROMPT, "émoji 🙂"])
def test_prompts_of_any_length_are_embedded(embedded: VideoModel, prompt: str) -> None:
    text = embedded.embed([prompt])
    assert text.shape[1] == MAX_TOKENS and bool(torch.isfinite(text).all())
    assert bool(torch.isfinite(embedded.velocity(latents(), 0.5, context(embedded, prompt=prompt))).all())


@torch.no_grad()
def test_words_matter_and_padding_does_not(embedded: VideoModel) -> None:
    one, two = embedded.embed(["a person, red top"]), embedded.embed(["a person, blue top"])
    assert not torch.allclose(one, two)
    assert float(embedded.embed([""])[0, 1:].abs().max()) == 0


@torch.no_grad()
def test_held_tokens_stand_still_and_are_seen_clean(embedded: VideoModel) -> None:
    free = context(embedded)
    held = torch.zeros(2, 3, 2, 2, dtype=torch.bool)
    held[0, 1, 0, 1] = True
    fixed = Context(**{**free.__dict__, "held": held})
    z = latents()
    velocity = embedded.velocity(z, 0.7, fixed)
    inside = held_latents(held).expand_as(z)
    assert float(velocity[inside].abs().max()) == 0 and float(velocity[~inside].abs().min()) > 0
    torch.testing.assert_close(hold(z, fixed)[inside], fixed.known[inside], rtol=0, atol=0)
    assert timesteps(torch.tensor([0.7, 0.7]), z, held)[0].reshape(3, 2, 2)[1, 0, 1] == 0
    # What is noise under a held token does not reach the network.
    other = torch.where(inside, torch.full_like(z, 9.0), z)
    torch.testing.assert_close(embedded.velocity(other, 0.7, fixed), velocity, rtol=0, atol=0)


def test_every_condition_reaches_the_input(embedded: VideoModel) -> None:
    full = context(embedded)
    readout = embedded.components.vae.cell_readout
    stacked = transformer_input(latents(), full, readout)
    for name in ("body", "azimuth", "coarse", "coverage"):
        changed = Context(**{**full.__dict__, name: getattr(full, name) + 0.5})
        assert not torch.equal(transformer_input(latents(), changed, readout), stacked), name


@pytest.mark.parametrize("names", [("coarse", "coverage"), ("body", "azimuth")])
def test_a_clip_that_lacks_a_condition_looks_the_same_in_a_batch_and_alone(
    embedded: VideoModel, names: tuple[str, str]
) -> None:
    """Training blanks conditions clip by clip, runs leave them out: the network must not be able to tell."""
    full, readout = context(embedded), embedded.components.vae.cell_readout
    parts = {name: getattr(full, name).clone() for name in names}
    for part in parts.values():
        part[1] = 0
    blanked = transformer_input(latents(), replace(full, **parts), readout)
    alone = replace(full, **dict.fromkeys(names))
    assert torch.equal(blanked[1], transformer_input(latents(), alone, readout)[1])
    assert torch.equal(blanked[0], transformer_input(latents(), full, readout)[0])


def test_half_a_condition_is_refused(embedded: VideoModel) -> None:
    text = embedded.embed(["a person"])
    with pytest.raises(ValueError, match="together with held"):
        Context(text, known=latents())
    with pytest.raises(ValueError, match="together with azimuths"):
        Context(text, body=torch.zeros(1, 3, 7, 8, 8))
    with pytest.raises(ValueError, match="together with their coverage"):
        Context(text, coarse=latents())
    with pytest.raises(ValueError, match="expected body maps"):
        transformer_input(
            latents(), Context(text, body=torch.zeros(2, 3, 7, 4, 4), azimuth=torch.zeros(2, 3)), torch.zeros(12, 17)
        )
