"""The training recipe on a corpus of two tiny shards: it runs, resumes, and what it writes is a prior that loads."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from safetensors.numpy import save_file

from ahoy_core.prior.autoencoder import FrameAutoencoder
from ahoy_core.prior.carry import cell_colours
from ahoy_core.prior.corpus.shards import VERSION
from ahoy_core.prior.text import build_text_encoder, build_tokenizer, embed_ids, token_ids
from ahoy_core.prior.train import flow, muon
from ahoy_core.prior.train.flow import FlowModel, draw_batch
from ahoy_core.prior.train.frames import (
    FramePool,
    fitted_readout,
    masked_psnr,
    start_from_principal_components,
    to_model,
)
from ahoy_core.prior.train.latents import LatentPool, encode_shard, pixel_weights, read_latents
from ahoy_core.prior.train.loop import Schedule, averaged, load_state, new_state, run, save_state
from ahoy_core.prior.video import load_video
from tasks import prior_training

CLIPS = 32


def write_shard(path: Path, seed: int) -> None:
    """People-like blobs: one colour a clip, in a box of the picture."""
    rng = np.random.default_rng(seed)
    image = np.full((CLIPS, 8, 128, 64, 3), 128, np.uint8)
    mask = np.zeros((CLIPS, 8, 128, 64), np.uint8)
    mask[:, :, 16:112, 16:48] = 255
    image[mask > 0] = np.repeat(rng.integers(0, 255, (CLIPS, 1, 3)), 8 * 96 * 32, 1).reshape(-1, 3)
    arrays = {
        "image": image,
        "mask": mask,
        "part": np.zeros_like(mask),
        "coarse": image // 2 + 60,
        "coverage": np.where(np.arange(8)[:, None, None] == 0, mask, 0).astype(np.uint8),
        "body": rng.integers(-127, 127, (CLIPS, 8, 7, 32, 16)).astype(np.int8),
        "azimuth": np.tile(np.arange(8, dtype=np.float32), (CLIPS, 1)),
        "observed": np.tile(np.arange(8) == 0, (CLIPS, 1)).astype(np.uint8),
    }
    meta = {
        "version": VERSION,
        "seed": seed,
        "prompts": ["a person, red top"] * CLIPS,
        "back_prints": [number % 2 == 1 for number in range(CLIPS)],
        "outfits": [],
    }
    save_file(arrays, path, {"ahoy": json.dumps(meta)})


@pytest.fixture(scope="module")
def corpus(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("corpus")
    for number, name in enumerate(("train-00000", "people-00000", "mesh-00000")):
        write_shard(folder / f"{name}.safetensors", number)
    return folder


def test_the_recipe_makes_a_prior_and_goes_on_from_its_checkpoints(corpus: Path, tmp_path: Path) -> None:
    rows: list[dict[str, float]] = []
    short = Schedule(minutes=0.05, warmup=2, log_steps=1, checkpoint_minutes=0.0)
    prior_training.train_autoencoder(corpus, tmp_path, short, rows.append, batch=4)
    assert rows and "psnr_people" in rows[-1]
    prior_training.encode_corpus(corpus, tmp_path, lambda _: None)
    clips = read_latents(tmp_path / "latents" / "train-00000.safetensors")
    assert clips.pictures.shape == (CLIPS, 8, 16, 16, 8) and len(clips.prompts) == CLIPS
    assert bool(clips.held[:, 0].all()) and not bool(clips.held[:, 1:, 2:6, 1:3].any())
    for _ in range(2):
        prior_training.train_flow(tmp_path, short, rows.append, batch=2, size=(24, 1))
    steps = [row["step"] for row in pq.read_table(tmp_path / "flow" / "curve.parquet").to_pylist()]
    assert steps == list(range(1, len(steps) + 1)), "the second run did not go on where the first stopped"
    video = load_video(tmp_path / "prior")
    frames = torch.rand(1, 3, 8, 128, 64)
    assert video.decode(video.encode(frames)).shape == frames.shape


def test_colours_of_cells_are_read_off_latents(tmp_path: Path) -> None:
    cells = np.random.default_rng(0).integers(0, 255, (16, 8, 32, 16, 3)).astype(np.uint8)
    image = cells.repeat(4, 2).repeat(4, 3)  # each cell of one colour: twelve numbers a patch, fewer than a latent has
    save_file(
        {"image": image, "mask": np.full(image.shape[:-1], 255, np.uint8)},
        tmp_path / "train-00000.safetensors",
        {"ahoy": json.dumps({"version": VERSION})},
    )
    pictures = to_model(image.reshape(-1, *image.shape[2:]))
    model = FrameAutoencoder()
    start_from_principal_components(model, pictures, torch.ones_like(pictures[:, :1]))
    model.register_to_config(latents_mean=[0.3] * 16, latents_std=[1.5] * 16)
    model.register_to_config(cell_readout=fitted_readout(model, tmp_path))
    with torch.no_grad():
        read = cell_colours(model.normalized(model.encode(pictures))[:, :, None], model.cell_readout)[:, 0]
    torch.testing.assert_close(read, pictures[:, :, ::4, ::4], rtol=0, atol=1e-3)


def test_channels_weigh_what_they_draw(pool: LatentPool) -> None:
    vae = FrameAutoencoder(widths=(8, 8, 8), latents_mean=[0.0] * 16, latents_std=[2.0, 1.0] * 8)
    linear: Any = vae.decoder_skip[0]
    with torch.no_grad():
        linear.weight.copy_(
            torch.linalg.qr(torch.randn(192, 16, generator=torch.Generator().manual_seed(0)))[0][..., None, None]
        )
    weights = pixel_weights(vae, pool.some(), frames=8)
    # An orthonormal decoder whose every second channel is doubled: four times the energy.
    torch.testing.assert_close(weights, torch.tensor([1.6, 0.4] * 8), rtol=0.05, atol=0)


@pytest.fixture(scope="module")
def pool(corpus: Path, tmp_path_factory: pytest.TempPathFactory) -> LatentPool:
    folder = tmp_path_factory.mktemp("latents")
    vae = FrameAutoencoder(widths=(8, 8, 8), latents_mean=[0.0] * 16, latents_std=[1.0] * 16)
    encode_shard(vae, corpus / "train-00000.safetensors", folder)
    return LatentPool(folder, "train", seed=0)


def test_who_is_told_in_words_is_told_nothing_else(pool: LatentPool) -> None:
    model = FlowModel(torch.zeros(12, 17), 24, 1)
    told = draw_batch(model, pool, 6, told_share=1.0)
    assert not told.context.held.any() and not told.context.coarse.any() and not told.context.coverage.any()
    assert torch.equal(told.ids, token_ids(model.tokenizer, ["a person, red top"] * len(told.ids))[0])
    others = draw_batch(model, pool, 6, told_share=0.0)
    assert others.context.held.any() and others.context.coarse.any()
    assert not torch.equal(others.ids, others.ids[:1].expand_as(others.ids))  # some hear nothing, or "a person" alone


def test_the_first_steps_hear_words_alone(pool: LatentPool, monkeypatch: pytest.MonkeyPatch) -> None:
    shares = []

    def noted(*arguments: object) -> object:
        shares.append(arguments[3])
        return draw_batch(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(flow, "draw_batch", noted)
    model, generator = FlowModel(torch.zeros(12, 17), 24, 1), torch.Generator().manual_seed(0)
    for step in (0, 10_000):
        assert torch.isfinite(flow.train_step(model, pool, 2, generator, step, torch.ones(16))[0])
    assert shares[0] == 1 and 0 < shares[1] < 1


@torch.no_grad()
def test_a_garment_starts_with_the_colour_of_the_word_before_it() -> None:
    tokenizer = build_tokenizer()
    encoder = build_text_encoder(len(tokenizer))
    ids, mask = token_ids(tokenizer, ["a person, red top, blue trousers", "a person, blue top, red trousers"])
    words = embed_ids(encoder, ids, mask)
    place = (ids[0] == tokenizer.convert_tokens_to_ids("▁top")).nonzero().item()
    difference = (words[0] - words[1])[place]
    # The second sixteen channels hold the word before; the first three of them its red, green and blue.
    assert float(difference[16]) > 0.3 and float(difference[18]) < -0.3
    elsewhere = torch.cat([difference[:16], difference[32:]]).abs().mean()
    assert float(difference[16:19].abs().mean()) > 2 * float(elsewhere)


def test_names_held_back_learn_at_a_share_of_the_rate(tmp_path: Path) -> None:
    model = torch.nn.ModuleDict({"quick": torch.nn.Linear(3, 1), "slow": torch.nn.Linear(3, 1)})
    state = new_state(model, seed=0, slow=lambda name: name.startswith("slow"))
    before = {name: value.clone() for name, value in model.state_dict().items()}

    def loss(step: int) -> tuple[torch.Tensor, dict[str, float]]:
        # One gradient alone: Adam's steps from it are shares of the rate, whatever its size.
        factor = 1.0 if step == 0 else 0.0
        return factor * sum(part(torch.ones(1, 3)).square().sum() for part in model.values()), {}

    run(state, Schedule(minutes=0.0005, lr=1e-2, warmup=1), loss, tmp_path / "s.safetensors", print)
    moved = {name: float((value - before[name]).abs().mean()) for name, value in model.state_dict().items()}
    assert moved["slow.bias"] == pytest.approx(0.3 * moved["quick.bias"], rel=1e-3) and moved["quick.bias"] > 0


def test_latents_survive_further_training_of_the_decoder(corpus: Path, tmp_path: Path) -> None:
    short = Schedule(minutes=0.02, warmup=2, log_steps=1)
    prior_training.train_autoencoder(corpus, tmp_path, short, lambda _: None, batch=4)
    pictures = torch.rand(2, 3, 64, 64) * 2 - 1
    before = FrameAutoencoder.from_pretrained(tmp_path / "vae")
    prior_training.train_autoencoder(corpus, tmp_path, short, lambda _: None, batch=4, decoder_only=True)
    after = FrameAutoencoder.from_pretrained(tmp_path / "vae")
    with torch.no_grad():
        assert torch.equal(before.encode(pictures), after.encode(pictures))
        assert not torch.equal(before(pictures), after(pictures))
        assert before.config.latents_std == after.config.latents_std


def test_the_linear_path_starts_as_a_principal_component_analysis(corpus: Path) -> None:
    pictures, masks = FramePool(corpus, seed=0).batch(0, 64)
    model = FrameAutoencoder()
    start_from_principal_components(model, pictures, masks)
    with torch.no_grad():
        latents = model.encode(pictures)
        inside = torch.nn.functional.avg_pool2d(masks, 8)[:, 0] > 0.05
        # Patches of one colour have three components; those latents have deviation 1, the rest next to none.
        deviations = latents.permute(0, 2, 3, 1)[inside].std(0)
        torch.testing.assert_close(deviations[:2], torch.ones(2), rtol=0.1, atol=0)
        assert masked_psnr(model.decode(latents) - pictures, masks) > 25


def test_a_state_comes_back_as_it_was(tmp_path: Path) -> None:
    def fresh() -> torch.nn.Module:
        torch.manual_seed(0)
        return torch.nn.Sequential(torch.nn.Linear(3, 4), torch.nn.Linear(4, 1))

    inputs = torch.randn(16, 3, generator=torch.Generator().manual_seed(1))

    def train(state: object, minutes: float) -> None:
        run(
            state,
            Schedule(minutes=minutes, lr=1e-2),
            lambda _: (state.model(inputs).square().mean(), {}),
            tmp_path / "s.safetensors",
            print,
        )  # type: ignore[attr-defined,arg-type]

    first = new_state(fresh(), seed=0)
    train(first, 0.002)
    again = new_state(fresh(), seed=0)
    load_state(again, tmp_path / "s.safetensors")
    assert again.step == first.step > 0
    for name, value in first.model.state_dict().items():
        assert torch.equal(again.model.state_dict()[name], value)
        assert torch.equal(again.average[name], first.average[name])
    with averaged(again) as model:
        assert torch.equal(model.state_dict()["0.weight"], first.average["0.weight"])
    assert torch.equal(again.model.state_dict()["0.weight"], first.model.state_dict()["0.weight"])
    save_state(again, tmp_path / "t.safetensors")
    assert (tmp_path / "t.safetensors").read_bytes() == (tmp_path / "s.safetensors").read_bytes()
    with pytest.raises(ValueError, match="weights of this model"):
        load_state(new_state(torch.nn.Linear(2, 2), seed=0), tmp_path / "s.safetensors")


def test_a_loss_that_is_not_finite_stops_the_training_before_the_weights_change(tmp_path: Path) -> None:
    state = new_state(torch.nn.Linear(2, 2), seed=0)
    before = {name: value.clone() for name, value in state.model.state_dict().items()}
    with pytest.raises(FloatingPointError, match="at step 0"):
        run(
            state,
            Schedule(minutes=0.1),
            lambda _: (torch.tensor(float("nan"), requires_grad=True), {}),
            tmp_path / "s",
            print,
        )
    assert all(torch.equal(before[name], value) for name, value in state.model.state_dict().items())


@pytest.mark.parametrize("shape", [(8, 8), (6, 20), (20, 6)])
def test_orthogonalised_updates_have_singular_values_near_one(shape: tuple[int, int]) -> None:
    matrix = torch.randn(shape, generator=torch.Generator().manual_seed(0))
    values = torch.linalg.svdvals(muon.orthogonalized(matrix))
    # The published quintic does not converge to 1, it stays within this band.
    assert float(values.min()) > 0.3 and float(values.max()) < 1.3


def test_pictures_reach_the_model_in_its_range() -> None:
    frames = np.array([[[[0, 128, 255]]]], np.uint8)
    torch.testing.assert_close(to_model(frames).flatten(), torch.tensor([-1.0, 128 / 127.5 - 1, 1.0]))


def test_configurations_of_a_schedule_are_frozen() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        Schedule().lr = 1.0  # type: ignore[misc]
