"""Identity fine-tuning: what is learned, what is left alone, and that a saved subject comes back bit by bit."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from safetensors import safe_open

from ahoy_core.prior.conditioning import Context
from ahoy_core.prior.config import IdentityConfig
from ahoy_core.prior.evidence import Frames
from ahoy_core.prior.identity import (
    add_identity,
    borrowed,
    experts,
    has_identity,
    load_identity,
    save_identity,
    train_identity,
    without_identity,
)
from ahoy_core.prior.text import IDENTITY_PROMPT, embedding_weight, identity_token_id
from ahoy_core.prior.video import VideoModel, load_video

FORMS = ("embedded", "a14b", "5b")


@pytest.fixture
def folders(embedded_folder: Path, wan_folders: dict[str, Path]) -> dict[str, Path]:
    return {"embedded": embedded_folder, **wan_folders}


def frames(count: int = 3) -> Frames:
    generator = torch.Generator().manual_seed(0)
    visible = torch.zeros(count, 1, 64, 64)
    visible[..., 16:48, 16:48] = 1
    return Frames(torch.rand(count, 3, 64, 64, generator=generator), visible)


def velocity(video: VideoModel, channels: int, tau: float) -> torch.Tensor:
    z = torch.randn(1, channels, 1, 8, 8, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        return video.velocity(z, tau, Context(video.embed([IDENTITY_PROMPT])))


@pytest.mark.parametrize("form", FORMS)
def test_a_subject_s_word_starts_as_a_person(form: str, folders: dict[str, Path]) -> None:
    video = load_video(folders[form])
    parts = video.components
    person = embedding_weight(parts.text_encoder)[parts.tokenizer("person", add_special_tokens=False).input_ids[0]]
    expected = person.detach().clone()
    train_identity(video, frames(), IdentityConfig(rank=1, steps=1, batch=1, token_lr=1e-9))
    learned = embedding_weight(parts.text_encoder)[identity_token_id(parts.tokenizer)]
    torch.testing.assert_close(learned, expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("form", FORMS)
def test_a_saved_subject_gives_the_same_velocity_bit_by_bit(
    form: str, folders: dict[str, Path], tmp_path: Path
) -> None:
    channels = 48 if form == "5b" else 16
    video = load_video(folders[form])
    before = [velocity(video, channels, tau) for tau in (0.95, 0.3)]
    train_identity(video, frames(), IdentityConfig(rank=3, steps=16, batch=2))
    after = [velocity(video, channels, tau) for tau in (0.95, 0.3)]
    assert all(not torch.equal(a, b) for a, b in zip(before, after, strict=True))  # both experts learned
    save_identity(video, tmp_path)
    again = load_video(folders[form])
    load_identity(again, tmp_path)
    for tau, expected in zip((0.95, 0.3), after, strict=True):
        assert torch.equal(velocity(again, channels, tau), expected)
    with without_identity(again):
        assert has_identity(again)
    names = sorted(path.name for path in tmp_path.iterdir())
    assert len(names) == 1 + len(experts(video)) and all(name.endswith(".safetensors") for name in names)
    with safe_open(tmp_path / "pytorch_lora_weights.safetensors", "pt") as handle:
        assert all(key.startswith("transformer.") and "lora" in key for key in handle.keys())  # noqa: SIM118


def test_diffusers_own_loader_reads_both_experts(folders: dict[str, Path], tmp_path: Path) -> None:
    from diffusers import WanPipeline

    video = load_video(folders["a14b"])
    train_identity(video, frames(), IdentityConfig(rank=2, steps=16, batch=2))
    save_identity(video, tmp_path)
    pipeline = WanPipeline.from_pretrained(folders["a14b"], local_files_only=True)
    first, second = "pytorch_lora_weights.safetensors", "pytorch_lora_weights_2.safetensors"
    pipeline.load_lora_weights(tmp_path, weight_name=first, adapter_name="identity")
    pipeline.load_lora_weights(tmp_path, weight_name=second, adapter_name="identity_2", load_into_transformer_2=True)
    z, text = torch.randn(1, 16, 1, 8, 8), video.embed([IDENTITY_PROMPT])
    with torch.no_grad():
        for ours, theirs in zip(experts(video), (pipeline.transformer, pipeline.transformer_2), strict=True):
            steps = torch.tensor([500.0])
            torch.testing.assert_close(
                ours(z, steps, text, return_dict=False)[0], theirs(z, steps, text, return_dict=False)[0], rtol=0, atol=0
            )


@pytest.mark.parametrize("form", FORMS)
def test_a_borrowed_model_is_given_back_as_it_was(form: str, folders: dict[str, Path], tmp_path: Path) -> None:
    channels, video = 48 if form == "5b" else 16, load_video(folders[form])
    before = [velocity(video, channels, tau) for tau in (0.95, 0.3)]
    for subject in range(2):
        with borrowed(video):
            train_identity(video, frames(), IdentityConfig(rank=2, steps=4, batch=2, seed=subject))
            assert not torch.equal(velocity(video, channels, 0.3), before[1])
            save_identity(video, tmp_path)
        assert not has_identity(video)
        for tau, expected in zip((0.95, 0.3), before, strict=True):
            assert torch.equal(velocity(video, channels, tau), expected)
    with borrowed(video):
        load_identity(video, tmp_path)
        assert not torch.equal(velocity(video, channels, 0.3), before[1])
    with pytest.raises(RuntimeError, match="cut off"), borrowed(video):
        add_identity(video, rank=2, seed=0)
        raise RuntimeError("cut off")
    assert torch.equal(velocity(video, channels, 0.3), before[1])


def test_activations_computed_anew_change_no_loss(
    wan_folders: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    from diffusers import WanTransformer3DModel as Network

    losses, switched = [], []
    enable = Network.enable_gradient_checkpointing
    for wanted in (True, False):

        def counted(network: Network, wanted: bool = wanted) -> None:
            switched.append(wanted)
            if wanted:
                enable(network)

        monkeypatch.setattr(Network, "enable_gradient_checkpointing", counted)
        video = load_video(wan_folders["5b"])
        losses.append(train_identity(video, frames(), IdentityConfig(rank=2, steps=3, batch=2)).losses)
        assert not experts(video)[0].is_gradient_checkpointing
    assert switched == [True, False]
    torch.testing.assert_close(losses[0], losses[1], rtol=1e-5, atol=0)


def test_half_precision_weights_are_updated_in_float32(wan_folders: dict[str, Path]) -> None:
    video = load_video(wan_folders["5b"], torch.bfloat16)
    train_identity(video, frames(), IdentityConfig(rank=2, steps=2, batch=2))
    kinds = {p.dtype for n, p in experts(video)[0].named_parameters() if "lora" in n}
    assert kinds == {torch.float32}
    assert bool(torch.isfinite(velocity(video, 48, 0.5)).all())


def test_a_fresh_adapter_changes_nothing(embedded: VideoModel) -> None:
    before = velocity(embedded, 16, 0.5)
    add_identity(embedded, rank=4, seed=0)
    torch.testing.assert_close(velocity(embedded, 16, 0.5), before, rtol=0, atol=1e-6)


def test_without_the_adapter_the_prior_is_as_it_was(embedded: VideoModel) -> None:
    z = torch.randn(1, 16, 1, 8, 8)
    text = embedded.embed(["a person"]).detach()
    with torch.no_grad():
        before = embedded.velocity(z, 0.5, Context(text))
        with torch.enable_grad():
            train_identity(embedded, frames(), IdentityConfig(rank=3, steps=8, batch=2))
        with without_identity(embedded):
            torch.testing.assert_close(embedded.velocity(z, 0.5, Context(text)), before, rtol=0, atol=1e-6)
        assert not torch.allclose(embedded.velocity(z, 0.5, Context(text)), before, atol=1e-5)


def test_the_loss_falls_on_one_usable_frame(embedded: VideoModel) -> None:
    curve = train_identity(embedded, frames(1), IdentityConfig(rank=4, steps=60, batch=4, lr=5e-3)).losses
    assert float(curve[-15:].mean()) < float(curve[:15].mean())


def test_hidden_pixels_do_not_matter(embedded_folder: Path) -> None:
    """What an occluder shows is kept out of the loss: other pixels there, far from what is seen, change nothing."""
    shown = frames(2)
    painted = shown.images.clone()
    # The autoencoder sees some pixels round a latent, so the change stays two latents away from the visible part.
    painted[..., :, :1] = 0.0
    losses = []
    for images in (shown.images, painted):
        video = load_video(embedded_folder)
        context_free = Frames(images, shown.visible)
        losses.append(train_identity(video, context_free, IdentityConfig(rank=2, steps=1, batch=2)).losses)
    # The network still sees the hidden latents as context, so the loss moves a little; the target does not.
    torch.testing.assert_close(losses[0], losses[1], rtol=5e-2, atol=0)


def test_frames_without_a_subject_are_refused() -> None:
    with pytest.raises(ValueError, match="visible subject"):
        Frames(torch.rand(2, 3, 64, 64), torch.zeros(2, 1, 64, 64))
    with pytest.raises(ValueError, match="expected images"):
        Frames(torch.rand(2, 3, 64, 64), torch.ones(2, 64, 64))


def test_a_second_subject_needs_a_fresh_prior(embedded: VideoModel) -> None:
    add_identity(embedded, rank=2, seed=0)
    with pytest.raises(ValueError, match="load the prior anew"):
        add_identity(embedded, rank=2, seed=0)


def test_a_missing_expert_is_named(folders: dict[str, Path], tmp_path: Path) -> None:
    video = load_video(folders["a14b"])
    train_identity(video, frames(), IdentityConfig(rank=2, steps=2, batch=2))
    save_identity(video, tmp_path)
    (tmp_path / "pytorch_lora_weights_2.safetensors").unlink()
    with pytest.raises(FileNotFoundError, match="weights_2"):
        load_identity(load_video(folders["a14b"]), tmp_path)
