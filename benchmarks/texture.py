"""The texture of captures whose truth is known: `python -m benchmarks.texture CAPTURES_DIR --json OUT`.

Pose, camera and visible mask are the true ones; `--shift-m` moves the body by that much noise in every frame, as a bad
fit would, `--drift` lets the camera's exposure wander (gain +-25 %, gamma +-0.1). One JSON line per capture and setting
of `--vary`, after one that names the machine. Shares are of the surface; errors are mean absolute differences, of 255,
from the true pictures: `texel_l1` of seen texels in the front camera, `unseen_l1` of texels that were never seen, in
each camera. `seam` is how much more neighbouring texels differ where they come from different frames than where they
come from one. `selfcheck` hides what was seen and lets the fillings compete: on one side of the body, whose other side
symmetry may copy, and in patches on both. Seconds are of the loop over frames (a frame that votes is looked at twice
and counted once); `cpu_seconds_once` is everything else; `peak_mb` is the process's.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ahoy_core.body.packaged import PackagedBody, load_packaged_body
from ahoy_core.captures import Capture, read_dataset
from ahoy_core.captures.fit import Fit, read_clip, true_fit
from ahoy_core.captures.texture_errors import texture_errors
from ahoy_core.cost import Bill, Meter, machine
from ahoy_core.roles import COMPLETIONS
from ahoy_core.texture.atlas import ObservedAtlas
from ahoy_core.texture.inputs import TextureConfig
from ahoy_core.texture.links import texel_links
from ahoy_core.texture.selfcheck import patches, score_fillings, side_of
from ahoy_core.texture.surface import Surface
from ahoy_core.texture.texels import TexelMap, texel_map, texel_normals
from ahoy_core.texture.texture import Texture, build_texture, canonical_vertices


def drifting(frames: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The clip as a camera with a wandering exposure would have recorded it."""
    phase = 2 * np.pi * np.arange(len(frames)) / len(frames)
    gain, gamma = 1 + 0.25 * np.sin(1.5 * phase), 1 + 0.1 * np.sin(2.5 * phase)
    levels = np.arange(256) / 255
    tables = np.clip(np.rint(255 * gain[:, None] * levels ** gamma[:, None]), 0, 255).astype(np.uint8)
    return np.stack([table[frame] for table, frame in zip(tables, frames, strict=True)])


def measure(
    capture: Capture, body: PackagedBody, config: TextureConfig, shift_m: float, drift: bool, check: bool
) -> dict[str, Any]:
    """Make one texture and compare it with the true pictures."""
    clip, truth = read_clip(capture), true_fit(capture, body)
    noise = np.random.default_rng(0).normal(0, shift_m, truth["transl"].shape).astype(np.float32)
    fit = {**truth, "transl": truth["transl"].astype(np.float32) + noise}
    clock: list[Bill] = []
    with Meter() as meter:
        texture = build_texture(
            drifting(clip.frames) if drift else clip.frames,
            clip.visible,
            fit,
            body,
            config,
            lambda done, total: clock.append(meter.read()),
        )
    bill = meter.read()
    # The first call ends a frame that includes what is prepared once, so the loop is measured from there on.
    per_frame = len(clock) / (len(clock) - 1) / len(clip.frames)
    cpu_s = (clock[-1].cpu_s - clock[0].cpu_s) * per_frame
    return {
        "capture": capture.name,
        "seconds_per_frame": round((clock[-1].wall_s - clock[0].wall_s) * per_frame, 4),
        "cpu_seconds_per_frame": round(cpu_s, 4),
        "cpu_seconds_once": round(bill.cpu_s - cpu_s * len(clip.frames), 2),
        "peak_mb": bill.peak_rss_mb,
        "observed": round(texture.notes["observed_share"], 3),
        "mirrored": round(texture.notes["mirrored_share"], 3),
        "diffused": round(texture.notes["diffused_share"], 3),
        "seam": seam(body, truth, texture),
        **texture_errors(capture, body, truth, texture.atlas_arrays()),
        **({"selfcheck": self_check(body, truth, texture)} if check else {}),
    }


def _texels(body: PackagedBody, fit: Fit, texture: Texture) -> tuple[Surface, TexelMap, NDArray[np.float32]]:
    surface = Surface.of(body)
    return surface, texel_map(surface, len(texture.chart)), canonical_vertices(body, fit["betas"])


def seam(body: PackagedBody, fit: Fit, texture: Texture) -> float:
    """Mean absolute difference, of 255, of neighbouring seen texels from different frames, beyond that within one."""
    surface, texels, vertices = _texels(body, fit, texture)
    pairs = texel_links(texels, texels.points(vertices, surface.faces), texel_normals(texels, vertices, surface))
    source, rgb = texture.source_frame.ravel()[texels.flat], texture.observed_rgb.reshape(-1, 3)[texels.flat]
    pairs = pairs[(source[pairs] >= 0).all(axis=1)]
    step = np.abs(rgb[pairs[:, 0]].astype(np.float64) - rgb[pairs[:, 1]]).mean(axis=1)
    apart = source[pairs[:, 0]] != source[pairs[:, 1]]
    return round(float(step[apart].mean() - step[~apart].mean()), 2) if apart.any() and (~apart).any() else 0.0


def self_check(body: PackagedBody, fit: Fit, texture: Texture) -> dict[str, Any]:
    """Errors of the fillings on hidden regions, by region hidden and filling."""
    surface, texels, vertices = _texels(body, fit, texture)
    points = texels.points(vertices, surface.faces)
    observed = ObservedAtlas(texture.observed_rgb, texture.coverage, texture.source_frame)
    regions = {
        "left side": side_of(points, vertices, left=True),
        "right side": side_of(points, vertices, left=False),
        "patches": patches(points, vertices, count=12, radius=0.08, rng=np.random.default_rng(0)),
    }
    found = {}
    for name, hidden in regions.items():
        scores = score_fillings(observed, surface, texels, vertices, hidden, COMPLETIONS)
        found[name] = {
            filling: {"l1": round(score.l1, 1), **{part: round(error, 1) for part, error in score.by_part.items()}}
            for filling, score in scores.items()
        }
    return found


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", type=Path, help="folder of captures, laid out as their README says")
    parser.add_argument("--json", type=Path, default=None, help="file for the lines; they are printed in any case")
    parser.add_argument("--set", nargs="*", default=[], metavar="KNOB=VALUE", help="knobs of TextureConfig")
    parser.add_argument(
        "--shift-m", type=float, default=0.0, help="noise of the body's place, metres an axis and frame"
    )
    parser.add_argument(
        "--vary", nargs="*", default=[], metavar="KNOB=A,B,...", help="knobs to take every combination of"
    )
    parser.add_argument("--drift", action="store_true", help="let the exposure wander over the clip")
    parser.add_argument("--selfcheck", action="store_true", help="let the fillings compete on hidden regions")
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args(arguments)
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    torch.set_num_threads(options.threads)
    given = dict(pair.split("=", 1) for pair in options.set)
    varied = {knob: values.split(",") for knob, values in (pair.split("=", 1) for pair in options.vary)}
    body = load_packaged_body()
    lines = [json.dumps({"machine": machine(), "set": given, "shift_m": options.shift_m, "drift": options.drift})]
    for capture in read_dataset(options.captures, "ours"):
        for values in product(*varied.values()):
            setting = dict(zip(varied, values, strict=True))
            config = TextureConfig.model_validate_strings({**given, **setting})
            row = measure(capture, body, config, options.shift_m, options.drift, options.selfcheck)
            lines.append(json.dumps({"capture": row.pop("capture"), **setting, **row}))
            print(lines[-1], flush=True)
    if options.json:
        options.json.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
