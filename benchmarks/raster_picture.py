"""The picture of docs/rasterizer.md: a scene, the peers, and what accuracy costs.

python -m benchmarks.raster_picture raster.jsonl docs/rasterizer.png
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import matplotlib

matplotlib.use("agg")
from matplotlib import pyplot
from matplotlib.axes import Axes

from ahoy_core.splat import rasterization
from benchmarks.scenes import SCENES, make_scene


def main() -> None:
    """Draw what the JSON lines of `benchmarks.raster` say."""
    if len(sys.argv) != 3:
        sys.exit(f"expected a JSON lines file and a target, got {sys.argv[1:]}; {__doc__}")
    rows = [json.loads(line) for line in Path(sys.argv[1]).read_text().splitlines()]
    figure, (scene, bars, precision) = pyplot.subplots(1, 3, figsize=(14, 4.4), dpi=100)
    _draw_scene(scene)
    _draw_bars(
        bars, [row for row in rows if row["kind"] == "speed" and row["pass"] == "forward+backward" and not row["gpu"]]
    )
    _draw_precision(precision, [row for row in rows if row["kind"] == "accuracy" and not row["failed"]])
    figure.tight_layout()
    figure.savefig(sys.argv[2])


def _draw_scene(axis: Axes) -> None:
    scene = make_scene(SCENES[1])
    args = (scene.means, scene.quats, scene.scales, scene.opacities, scene.colors, scene.viewmats, scene.Ks)
    image, _, _ = rasterization(*args, scene.spec.size, scene.spec.size, backgrounds=scene.backgrounds)
    axis.imshow(image[0].clamp(0, 1).numpy())
    axis.set_title(f"{scene.spec.name}: {scene.spec.n:,} Gaussians")
    axis.axis("off")


def _draw_bars(axis: Axes, rows: list[dict]) -> None:
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    peers = list(dict.fromkeys(row["peer"] for row in rows))
    width = 0.8 / len(peers)
    for i, peer in enumerate(peers):
        mine = {row["scene"]: row["cpu_ms"] for row in rows if row["peer"] == peer}
        places = [s + i * width for s, name in enumerate(scenes) if name in mine]
        medians = [mine[name]["median"] for name in scenes if name in mine]
        spread = [[mine[n]["median"] - mine[n]["low"] for n in scenes if n in mine]]
        spread.append([mine[n]["high"] - mine[n]["median"] for n in scenes if n in mine])
        axis.bar(places, medians, width, yerr=spread, label=peer, capsize=2)
    axis.set_yscale("log")
    axis.set_xticks([s + 0.4 - width / 2 for s in range(len(scenes))], scenes)
    axis.set_ylabel("forward + backward, CPU ms")
    axis.set_title("beside its peers")
    axis.legend(fontsize=8)


def _draw_precision(axis: Axes, rows: list[dict]) -> None:
    for knob in dict.fromkeys(row["sweep"] for row in rows):
        mine = [row for row in rows if row["sweep"] == knob]
        times = [row["cpu_s"]["median"] * 1e3 for row in mine]
        errors = [row["errors"]["image_rms"] for row in mine]
        axis.loglog(times, errors, "o-", markersize=4, linewidth=0.8, label=knob.removeprefix("raster."))
    axis.set_xlabel("forward + backward, CPU ms (2k Gaussians, 128 x 128)")
    axis.set_ylabel("image error, rms, against the float64 oracle")
    axis.set_title("what accuracy costs")
    axis.legend(fontsize=8)


if __name__ == "__main__":
    main()
