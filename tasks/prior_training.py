"""Runs the trainings of the prior in a folder: checkpoints, curves in Parquet, and the result in diffusers' format."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import torch

from ahoy_core.prior.train.loop import Row, Schedule, averaged, load_state, new_state, run

AUTOENCODER = "vae"
_STATE = "state.safetensors"
_CURVE = "curve.parquet"
# Matrices that see few or odd inputs learn worse under orthogonalised updates: tables, first and last layers.
_FLOW_VECTORS = ("text_encoder", "embed", "scale_shift_table", "proj_out")


class Curve:
    """Rows of figures, kept in a Parquet file that grows with the training and survives its interruptions.

    Args:
        path: of the file.
        note: called with each row as well.
    """

    def __init__(self, path: Path, note: Callable[[Row], None]) -> None:
        self.path, self.note = path, note
        self.rows: list[Row] = pq.read_table(path).to_pylist() if path.exists() else []

    def add(self, row: Row) -> None:
        """Appends a row; figures that it lacks are null."""
        self.rows.append(row)
        names = sorted({name for known in self.rows for name in known})
        columns = {name: [known.get(name) for known in self.rows] for name in names}
        temporary = self.path.with_suffix(".tmp")
        pq.write_table(pa.table(columns), temporary)
        temporary.replace(self.path)
        self.note(row)


def train_autoencoder(
    corpus: Path,
    folder: Path,
    schedule: Schedule,
    note: Callable[[Row], None],
    batch: int = 24,
    decoder_only: bool = False,
) -> None:
    """Trains the autoencoder, or goes on training it; writes `folder/vae` at the end.

    Args:
        corpus: folder of shards.
        folder: of this prior.
        schedule: times and rates.
        note: sees every row of the curve.
        batch: crops a step.
        decoder_only: leave the encoder, and so the latents that a flow was trained on, as they are; the prior that is
            there gets the new decoder.
    """
    from ahoy_core.prior.autoencoder import FrameAutoencoder
    from ahoy_core.prior.corpus.shards import shards
    from ahoy_core.prior.format import save_autoencoder
    from ahoy_core.prior.train.frames import (
        FramePool,
        autoencoder_loss,
        autoencoder_psnr,
        fitted_readout,
        latent_statistics,
        start_from_principal_components,
    )

    torch.manual_seed(0)
    work = folder / ("decoder" if decoder_only else "autoencoder")
    work.mkdir(parents=True, exist_ok=True)
    model = FrameAutoencoder.from_pretrained(folder / AUTOENCODER) if decoder_only else FrameAutoencoder()
    if decoder_only:
        model.encoder.requires_grad_(False)
        model.encoder_skip.requires_grad_(False)
    pool = FramePool(corpus, seed=0)
    if not decoder_only and not (work / _STATE).exists():
        start_from_principal_components(model, *pool.batch(0, 512))
    state = new_state(model.train(), seed=0)
    if (work / _STATE).exists():
        load_state(state, work / _STATE)
        pool = FramePool(corpus, seed=state.step)
    generator = torch.Generator().manual_seed(state.step)

    def evaluate() -> Row:
        held = {split: shards(corpus, split)[:1] for split in ("people", "mesh")}
        return {f"psnr_{split}": autoencoder_psnr(model, paths[0]) for split, paths in held.items() if paths}

    run(
        state,
        schedule,
        lambda step: autoencoder_loss(model, *pool.batch(step, batch), generator),
        work / _STATE,
        Curve(work / _CURVE, note).add,
        evaluate,
    )
    with averaged(state):
        if not decoder_only:
            mean, std = latent_statistics(model, corpus)
            model.register_to_config(latents_mean=mean, latents_std=std)
            model.register_to_config(cell_readout=fitted_readout(model, corpus))
        save_autoencoder(folder / AUTOENCODER, model)
        if decoder_only and (folder / "prior").exists():
            save_autoencoder(folder / "prior" / "vae", model)


def encode_corpus(corpus: Path, folder: Path, note: Callable[[str], None], every: int = 1) -> None:
    """Writes the latents of every shard of a corpus to `folder/latents`, held-out splits first.

    Args:
        corpus: folder of shards.
        folder: of this prior, with its finished autoencoder.
        note: called with each new file's name.
        every: take every so many clips of a shard.
    """
    from ahoy_core.prior.autoencoder import FrameAutoencoder
    from ahoy_core.prior.corpus.shards import shards
    from ahoy_core.prior.corpus.wardrobe import SPLITS
    from ahoy_core.prior.train.latents import encode_shard

    vae = FrameAutoencoder.from_pretrained(folder / AUTOENCODER).eval()
    latents = folder / "latents"
    latents.mkdir(exist_ok=True)
    held_out = [path for split in SPLITS if split != "train" for path in shards(corpus, split)[:1]]
    train = shards(corpus, "train")
    for path in [*train[:2], *held_out[:2], *train[2:4], *held_out[2:], *train[4:]]:
        if not (latents / path.name).exists():
            note(encode_shard(vae, path, latents, every).name)


def train_flow(
    folder: Path, schedule: Schedule, note: Callable[[Row], None], batch: int = 10, size: tuple[int, int] = (160, 4)
) -> None:
    """Trains transformer and text encoder on `folder/latents`, or goes on; writes the whole prior to `folder/prior`.

    Args:
        folder: of this prior, with autoencoder and latents.
        schedule: times and rates.
        note: sees every row of the curve.
        batch: clips of eight frames a step (twice as many of four).
        size: width and layers of the transformer.
    """
    from ahoy_core.prior.autoencoder import FrameAutoencoder
    from ahoy_core.prior.format import save_prior
    from ahoy_core.prior.train.flow import FixedValidation, FlowModel, learns_slowly, train_step
    from ahoy_core.prior.train.latents import LatentPool, pixel_weights

    torch.manual_seed(1)
    work = folder / "flow"
    work.mkdir(parents=True, exist_ok=True)
    vae = FrameAutoencoder.from_pretrained(folder / AUTOENCODER)
    model = FlowModel(vae.cell_readout, *size)
    state = new_state(model.train(), seed=1, plain=_FLOW_VECTORS, slow=learns_slowly)
    if (work / _STATE).exists():
        load_state(state, work / _STATE)
    latents = folder / "latents"
    pool = LatentPool(latents, "train", seed=state.step)
    generator = torch.Generator().manual_seed(state.step)
    channels = pixel_weights(vae, pool.some())
    held = {split: FixedValidation(LatentPool(latents, split, 0)) for split in ("people", "mesh")}

    def evaluate() -> Row:
        clips = pool.refresh()
        losses = {f"loss_{split}": fixed.loss(model) for split, fixed in held.items()}
        heard = {f"heard_{split}": fixed.heard(model) for split, fixed in held.items()}
        return {"train_clips": clips, **losses, **heard}

    run(
        state,
        schedule,
        lambda step: train_step(model, pool, batch, generator, step, channels),
        work / _STATE,
        Curve(work / _CURVE, note).add,
        evaluate,
    )
    with averaged(state):
        save_prior(folder / "prior", model.transformer, vae, model.text_encoder, model.tokenizer)
