"""The least time this machine could take for a scene, from the pairs that must be blended.

    floor = pairs x (F + B) / (lanes x issue x clock)

`pairs` is what blends (alpha >= 1/255, transmittance > 1e-4), counted pixel by pixel; `F` and `B` are the vector
instructions that one pair costs forward and backward, with every load, store, address, sort and projection free;
`lanes` is the 8 float32 of AVX2, `issue` 2 vector instructions a cycle. CPU time, so threads do not enter.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from ahoy_core.splat import rasterization
from benchmarks.pairs import count_pairs
from benchmarks.scenes import Scene

F = 4 + 9 + 3 + 4 + 2  # quadratic, exp2, clamp and masks, transmittance and three colours, last index
B = 4 + 9 + 3 + 6 + 4 + 11  # the same again, suffix sum and division, three colours, nine moments
LANES, ISSUE = 8, 2


def floor_row(scene: Scene) -> dict[str, float]:
    """Count the scene's pairs and return the floor in CPU milliseconds."""
    size = scene.spec.size
    args = (scene.means, scene.quats, scene.scales, scene.opacities, scene.colors, scene.viewmats, scene.Ks)
    meta = rasterization(*args, size, size)[2]
    offsets = np.append(meta["isect_offsets"].reshape(-1).numpy(), int(meta["n_isects"])).astype(np.int64)
    arrays = (meta["means2d"][0].numpy(), meta["conics"][0].numpy(), scene.opacities.numpy())
    evaluated, blended = count_pairs(*arrays, size, size, int(meta["tile_size"]), offsets, meta["flatten_ids"].numpy())
    seconds = blended * (F + B) / (LANES * ISSUE * clock_hz())
    return {
        "evaluated_per_pixel": evaluated / size**2,
        "blended_per_pixel": blended / size**2,
        "clock_ghz": clock_hz() / 1e9,
        "floor_ms": seconds * 1e3,
    }


def clock_hz() -> float:
    """The processor's stated clock; 3 GHz where the system does not say."""
    info = Path("/proc/cpuinfo")
    found = re.search(r"cpu MHz\s*:\s*([\d.]+)", info.read_text()) if info.exists() else None
    return float(found.group(1)) * 1e6 if found else 3e9
