"""`ahoy prior`: make the corpus, train the prior, measure it, write its card."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

app = typer.Typer(no_args_is_help=True, help="The generative prior: its corpus, its training, its figures.")
console = Console()

CorpusFolder = Annotated[Path, typer.Argument(help="Folder of the corpus (made if it is not there).")]


@app.command()
def corpus(
    folder: CorpusFolder,
    assets: Annotated[Path, typer.Option(help="MakeHuman's CC0 assets: clothes, hair, eyebrows.")],
    shards: Annotated[int, typer.Option(help="Training shards wanted (128 clips each).", min=0)] = 160,
    held_out: Annotated[int, typer.Option(help="Shards of each held-out split.", min=0)] = 2,
    seed: Annotated[int, typer.Option(help="Of the whole corpus.")] = 6,
) -> None:
    """Render shards that are not there yet. Start it several times to use several cores; interrupt it at will."""
    from ahoy_core.body.packaged import load_packaged_body
    from ahoy_core.prior.corpus.shards import ShardId, claimed, make_shard
    from ahoy_core.prior.corpus.wardrobe import SPLITS, Wardrobe

    _use_threads(1)
    folder.mkdir(parents=True, exist_ok=True)
    body, wardrobe = load_packaged_body(), Wardrobe(assets)
    held = [ShardId(split, k) for k in range(held_out) for split in SPLITS if split != "train"]
    train = [ShardId("train", k) for k in range(shards)]
    # The first training shards come first, so that training can start; then what it is measured on.
    for shard in claimed(folder, [*train[:4], *held, *train[4:]]):
        path = make_shard(folder, shard, seed, body, wardrobe)
        console.print(f"{path.name} ({path.stat().st_size / 2**20:.0f} MB)", highlight=False)


@app.command()
def train(
    what: Annotated[str, typer.Argument(help="autoencoder, decoder (latents stay as they are) or flow.")],
    corpus_folder: Annotated[Path, typer.Option("--corpus", help="Folder of shards.")],
    out: Annotated[Path, typer.Option(help="Folder of the prior; what is there is trained further.")],
    minutes: Annotated[float, typer.Option(help="Wall time of this run.", min=0.0)] = 30.0,
    cooldown: Annotated[float, typer.Option(help="Last share of this run with a falling rate.", min=0, max=1)] = 0.0,
    lr: Annotated[float, typer.Option(help="Learning rate.", min=0.0)] = 2e-3,
    horizon: Annotated[float, typer.Option(help="Steps that the averaged weights reach back.", min=1)] = 250.0,
    threads: Annotated[int, typer.Option(help="Threads.", min=1)] = 1,
) -> None:
    """Train for some minutes, or go on where the last run stopped."""
    from ahoy_core.prior.train.loop import Schedule
    from tasks import prior_training

    _use_threads(threads)
    log_steps = 20 if what == "flow" else 50
    schedule = Schedule(lr=lr, minutes=minutes, cooldown=cooldown, log_steps=log_steps, horizon=horizon)

    def note(row: dict[str, float]) -> None:
        console.print("  ".join(f"{name} {value:.4g}" for name, value in row.items()), highlight=False, soft_wrap=True)

    if what in ("autoencoder", "decoder"):
        prior_training.train_autoencoder(corpus_folder, out, schedule, note, decoder_only=what == "decoder")
    elif what == "flow":
        prior_training.train_flow(out, schedule, note)
    else:
        raise typer.BadParameter(f"expected autoencoder, decoder or flow, got {what!r}")


@app.command()
def encode(
    corpus_folder: Annotated[Path, typer.Option("--corpus", help="Folder of shards.")],
    out: Annotated[Path, typer.Option(help="Folder of the prior, with its finished autoencoder.")],
    every: Annotated[int, typer.Option(help="Take every so many clips of a shard.", min=1)] = 1,
    threads: Annotated[int, typer.Option(help="Threads.", min=1)] = 1,
) -> None:
    """Turn shards into the latents that the flow is trained on; what is there stays."""
    from tasks import prior_training

    _use_threads(threads)
    prior_training.encode_corpus(corpus_folder, out, lambda name: console.print(name, highlight=False), every)


@app.command("eval")
def evaluate(
    prior: Annotated[Path, typer.Argument(help="Folder of a prior.")],
    corpus_folder: Annotated[Path, typer.Option("--corpus", help="Folder of shards, held-out splits among them.")],
    out: Annotated[Path, typer.Option(help="JSON file to write.")],
    clips: Annotated[int, typer.Option(help="Clips of each split.", min=1)] = 24,
    threads: Annotated[int, typer.Option(help="Threads.", min=1)] = 1,
) -> None:
    """Measure a prior on people, garments and motions that it was not trained on."""
    from ahoy_core.prior.evaluate import held_out
    from ahoy_core.prior.video import load_video
    from tasks.fills import Fills
    from tasks.roles import perceptual_network

    _use_threads(threads)
    figures = held_out(load_video(prior), corpus_folder, clips, perceptual=perceptual_network(Fills()))
    out.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
    console.print_json(data=figures)


@app.command()
def draw(
    prompts: Annotated[list[str], typer.Argument(help='Like "a person, red top, blue trousers".')],
    out: Annotated[Path, typer.Option(help="PNG to write: four canonical views a prompt.")],
    prior: Annotated[str, typer.Option(help="packaged, or a prior's folder.")] = "packaged",
    steps: Annotated[int, typer.Option(help="1 draws the mean of what the words allow, 12 a sample.", min=1)] = 1,
    seed: Annotated[int, typer.Option(help="Of the noise.", min=0)] = 0,
) -> None:
    """Draw what the prior makes of words: the average adult from front, left, back and right."""
    from tasks.prior_drawing import draw_words

    draw_words(prior, prompts, out, steps, seed)
    console.print(str(out), highlight=False)


@app.command()
def card(
    folder: Annotated[Path, typer.Argument(help="Folder of the trainings.")],
    corpus_folder: Annotated[Path, typer.Option("--corpus", help="Folder of shards.")],
    figures: Annotated[Path, typer.Option(help="What `ahoy prior eval` wrote.")],
) -> None:
    """Write the model card: data, licence, splits, seeds, curves, figures."""
    from tasks.prior_card import write_card

    path = write_card(folder, corpus_folder, json.loads(figures.read_text(encoding="utf-8")))
    console.print(str(path), highlight=False)


def _use_threads(count: int) -> None:
    import torch  # not with the module: every other command would wait for it

    torch.set_num_threads(count)
