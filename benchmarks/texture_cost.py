"""What the texture's accuracy costs: `python -m benchmarks.texture_cost CAPTURE_DIR --json ROWS --plot PNG`.

One capture with true pose, camera and mask; atlas size, frame stride, rule and fill are swept one at a time round the
default, each timed once in turn (CPU time), its error the mean absolute one, of 255, of seen texels in the front camera
and of never-seen texels in all cameras.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import torch

from ahoy_core.body.packaged import load_packaged_body
from ahoy_core.cost import Measurement, pareto, sweep, write_jsonl
from ahoy_core.texture.inputs import TextureConfig
from ahoy_core.texture.texture import Texture, build_texture
from benchmarks.captures import read_capture, true_fit
from benchmarks.texture import colour_scores

SWEEPS: Mapping[str, tuple[Any, ...]] = {
    "atlas_size": (128, 256, 512, 1024),
    "frame_stride": (1, 2, 4, 8, 16),
    "rule": ("first", "best", "median"),
    "fill": ("both", "harmonic", "symmetric"),
}


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path, help="folder of one capture")
    parser.add_argument("--json", type=Path, required=True, help="file for the rows")
    parser.add_argument("--plot", type=Path, default=None, help="file for the diagram")
    parser.add_argument("--sweeps", nargs="*", default=list(SWEEPS), choices=list(SWEEPS))
    parser.add_argument("--repeats", type=int, default=1)
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    body, capture = load_packaged_body(), read_capture(options.capture)
    fit = true_fit(capture, body)

    def run(setting: Mapping[str, Any]) -> Texture:
        return build_texture(capture.frames, capture.visible, fit, body, TextureConfig(**setting))

    def error(texture: Texture) -> Mapping[str, float]:
        scores = colour_scores(capture, body, fit, texture)
        unseen = list(scores["unseen_l1"].values())
        return {"texel_l1": scores["texel_l1"], "unseen_l1": sum(unseen) / len(unseen)}

    rows: list[Measurement] = []
    for knob in options.sweeps:
        rows += sweep(f"texture.{knob}", [{knob: value} for value in SWEEPS[knob]], run, error, repeats=options.repeats)
        write_jsonl(options.json, rows)
    for row in rows:
        cost = row.failed or f"{row.cpu_s.median:.1f} CPU-s" if row.cpu_s else row.failed
        print(row.sweep, dict(row.setting), {name: round(value, 2) for name, value in row.errors.items()}, cost)
    if options.plot:
        plot(rows, options.plot)


def plot(rows: Sequence[Measurement], path: Path) -> None:
    """Work-precision diagrams: error against CPU seconds, one line a knob, the Pareto set ringed."""
    matplotlib.use("agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 2, figsize=(11, 4), dpi=100)
    for axis, name in zip(axes, ("texel_l1", "unseen_l1"), strict=True):
        for knob in dict.fromkeys(row.sweep for row in rows):
            own = [row for row in rows if row.sweep == knob and row.cpu_s is not None]
            axis.plot([r.cpu_s.median for r in own if r.cpu_s], [r.errors[name] for r in own], "o-", label=knob)
            for row in own:
                if row.cpu_s:
                    axis.annotate(str(*row.setting.values()), (row.cpu_s.median, row.errors[name]), fontsize=7)
        best = pareto(rows, name)
        axis.scatter(
            [r.cpu_s.median for r in best if r.cpu_s], [r.errors[name] for r in best], 90, "none", "o", edgecolors="k"
        )
        axis.set(xlabel="CPU-s a clip of 48 frames", ylabel=f"{name}, of 255", xscale="log")
    axes[0].legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(path)
    pyplot.close(figure)


if __name__ == "__main__":
    main()
