"""The model card of a trained prior: what it was trained on and how, what it reaches, what it is not for."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib
import pyarrow.parquet as pq

from ahoy_core.prior.corpus import wardrobe
from ahoy_core.prior.corpus.poses import ACTIONS, HELD_OUT_ACTIONS
from ahoy_core.prior.corpus.shards import CLIPS

_PARTS = ("autoencoder", "flow", "decoder")

_TEXT = """# The embedded prior

A small rectified-flow video model of clothed people, in the folder layout of a diffusers Wan pipeline. Given a body in
motion, and what was seen of a person, it proposes what was not seen. It knows no real person and no real face.

- **Licence**: Apache-2.0, as the code. Synthetic training pictures only.
- **Data**: {clips} rendered clips of 8 frames, 128 x 64, made by `ahoy prior corpus` (corpus seed {seed}) on the free
  body (Anny, Apache-2.0; data CC0) with MakeHuman's CC0 clothes, shoes, hair and eyebrows, procedural garments, prints
  and skin tones. Nothing else.
- **Splits**: trained on suits {suits}, shoes {shoes}, hair {hair}, actions {actions}. Held out: new people;
  the meshes {held_suits}, {held_shoes}, {held_hair}; the textures of {untextured}; the actions {held_actions}.
  In no split, because the development captures wear them: {never}.
- **Model**: {model}.
- **Training**: {training}. Seeds 0 (autoencoder, decoder) and 1 (flow).
- **Limits**: one person over grey at 128 x 64; prints on an unseen back cannot be known; faces are rendered
  ones: it must not be used to invent a face. What it makes is synthetic media and is labelled so downstream.

## Figures

{figures}
"""


def write_card(folder: Path, corpus: Path, figures: Mapping[str, Any]) -> Path:
    """Writes `folder/prior/README.md` and the curves beside it.

    Args:
        folder: of the trainings, with `autoencoder`, `flow` and `prior` in it.
        corpus: folder of shards, to count them.
        figures: what `ahoy prior eval` said.

    Returns:
        The card.
    """
    out = folder / "prior"
    found = {part: folder / part / "curve.parquet" for part in _PARTS}
    curves = {part: pq.read_table(path).to_pylist() for part, path in found.items() if path.exists()}
    _plot(curves, out / "curves.png")
    first = next(iter(sorted(corpus.glob("train-*.safetensors"))), None)
    text = _TEXT.format(
        clips=len(list(corpus.glob("train-*.safetensors"))) * CLIPS,
        seed=_seed(first),
        suits=", ".join(wardrobe.SUITS),
        shoes=", ".join(wardrobe.SHOES),
        hair=", ".join(wardrobe.HAIR),
        actions=", ".join(ACTIONS),
        held_suits=", ".join(wardrobe.HELD_OUT_SUITS),
        held_shoes=", ".join(wardrobe.HELD_OUT_SHOES),
        held_hair=", ".join(wardrobe.HELD_OUT_HAIR),
        untextured=", ".join(wardrobe.UNTEXTURED),
        held_actions=", ".join(HELD_OUT_ACTIONS),
        never=", ".join(wardrobe.NEVER),
        model=_model(out),
        training="; ".join(_training(part, rows) for part, rows in curves.items()),
        figures=_figures(figures),
    )
    card = out / "README.md"
    card.write_text(text, encoding="utf-8")
    return card


def _seed(shard: Path | None) -> str:
    if shard is None:
        return "unknown"
    from safetensors import safe_open

    with safe_open(shard, "numpy") as handle:
        return str(json.loads(handle.metadata()["ahoy"])["seed"])


def _model(out: Path) -> str:
    config = json.loads((out / "transformer" / "config.json").read_text())
    width = config["num_attention_heads"] * config["attention_head_dim"]
    megabytes = sum(path.stat().st_size for path in out.rglob("*.safetensors")) / 2**20
    return (
        f"`WanTransformer3DModel` of width {width} and {config['num_layers']} layers with {config['in_channels']} "
        "input channels (latents, body maps, azimuth, coarse latents, coverage, carried colours); `FrameAutoencoder`, "
        f"8x down, 16 channels; `UMT5EncoderModel` with its own vocabulary; {megabytes:.1f} MB of weights"
    )


def _training(part: str, rows: list[dict[str, Any]]) -> str:
    last = rows[-1]
    return f"{part} {int(last['step'])} steps in {last['cpu_seconds']:.0f} CPU-seconds"


def _figures(figures: Mapping[str, Any]) -> str:
    names = ["split", "autoencoder, PSNR in mask", *_COLUMNS]
    lines = ["| " + " | ".join(names) + " |", "|---" * len(names) + "|"]
    for split, found in figures.items():
        values = [found[group][key] for group, key in _COLUMNS.values()]
        cells = " | ".join(f"{value:.1f}" for value in values)
        lines.append(f"| {split} | {found['autoencoder_psnr_mask']:.1f} | {cells} |")
    return "\n".join(lines)


_COLUMNS = {
    "back torso, mean": ("back_from_front", "mean/torso"),
    "mirror": ("back_from_front", "mirror/torso"),
    "garment colour": ("back_from_front", "colours/torso"),
    "back legs, mean": ("back_from_front", "mean/legs"),
    "legs, mirror": ("back_from_front", "mirror/legs"),
    "coarse, unobserved": ("repaired", "coarse/unobserved"),
    "clean-up, 1 step": ("repaired", "clean-up 1 step/unobserved"),
    "RF-inversion 0.8": ("repaired", "inversion 0.8, gamma 0.5/unobserved"),
}


def _plot(curves: Mapping[str, list[dict[str, Any]]], path: Path) -> None:
    matplotlib.use("agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, len(curves), figsize=(5 * len(curves), 3), dpi=110)
    for axis, (part, rows) in zip(axes, curves.items(), strict=True):
        names = sorted({name for row in rows for name in row if name.startswith(("loss", "psnr"))})
        for name in names:
            points = [(row["step"], row[name]) for row in rows if row.get(name) is not None]
            axis.plot(*zip(*points, strict=True), ".-", markersize=3, linewidth=1, label=name)
        axis.set(xlabel="step", title=part)
        axis.legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(path)
    pyplot.close(figure)
