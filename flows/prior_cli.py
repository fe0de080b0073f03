"""`ahoy prior`: make the corpus, train the prior, measure it, write its card."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import torch
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

    torch.set_num_threads(1)
    folder.mkdir(parents=True, exist_ok=True)
    body, wardrobe = load_packaged_body(), Wardrobe(assets)
    held = [ShardId(split, k) for k in range(held_out) for split in SPLITS if split != "train"]
    train = [ShardId("train", k) for k in range(shards)]
    # The first training shards come first, so that training can start; then what it is measured on.
    for shard in claimed(folder, [*train[:4], *held, *train[4:]]):
        path = make_shard(folder, shard, seed, body, wardrobe)
        console.print(f"{path.name} ({path.stat().st_size / 2**20:.0f} MB)", highlight=False)
