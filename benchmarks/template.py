"""How well the canonical template covers the body at each map size: `python -m benchmarks.template --json OUT`.

One JSON line per size, after one that names the machine; default shape, points spread evenly over the textured surface.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import torch
from scipy.spatial import cKDTree

from ahoy_core.body.canonical import canonical_pose
from ahoy_core.body.packaged import load_packaged_body
from ahoy_core.cost import Meter, machine
from ahoy_core.maps.charts import Surface
from ahoy_core.maps.template import build_template, sample_surface, textured_faces

REACH_M = 0.015
POINTS = 50_000


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, default=None, help="file for the lines; they are printed in any case")
    parser.add_argument("--sizes", type=int, nargs="+", default=[64, 128, 256, 512])
    options = parser.parse_args()
    torch.set_num_threads(1)
    body = load_packaged_body()
    posed = body(canonical_pose(body)[None], body.default_betas[None], torch.zeros(1, 3)).vertices[0]
    surface = Surface.of(posed.double().numpy(), body.faces[textured_faces(body)].numpy())
    points = surface.at(*sample_surface(surface, POINTS, seed=99))
    lines = [json.dumps({"machine": machine()})]
    for size in options.sizes:
        with Meter() as meter:
            template = build_template(body, body.default_betas, size)
        away = cKDTree(template.means.numpy()).query(points)[0]
        row = {
            "map_size": size,
            "gaussians": len(template),
            "within_15_mm": round(float((away <= REACH_M).mean()), 4),
            "farthest_mm": round(float(away.max()) * 1000, 1),
            "cpu_seconds": round(meter.read().cpu_s, 2),
        }
        lines.append(json.dumps(row))
        print(lines[-1], flush=True)
    if options.json:
        options.json.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
