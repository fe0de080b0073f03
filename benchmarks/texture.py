"""The texture of captures whose truth is known: `python -m benchmarks.texture CAPTURES_DIR --json OUT`.

Pose, camera and visible mask are the true ones; `--shift-m` moves the body by that much noise in every frame, as a bad
fit would. One JSON line per capture, mode (first or best view of a texel wins) and alignment (on or off), after one
that names the machine. Shares are of the surface. `colour_error` is the mean absolute difference, of 255, between
texels that were seen and the true front view; `psnr_seen` and `psnr_filled` are over all four cameras, by whether the
texel was seen. `seconds_per_frame` and `cpu_seconds_per_frame` are those of the loop over frames (a frame that votes is
looked at twice and counted once), `cpu_seconds_once` of everything else; `peak_mb` is the process's.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ahoy_core.body.packaged import PackagedBody, load_packaged_body
from ahoy_core.cost import Bill, Meter, machine
from ahoy_core.texture.inputs import TextureConfig
from ahoy_core.texture.rays import Caster, hit_map, to_camera
from ahoy_core.texture.surface import Surface, interpolate_uv
from ahoy_core.texture.texels import pad_charts, sample_atlas
from ahoy_core.texture.texture import Texture, build_texture
from benchmarks.captures import Capture, capture_folders, posed_vertices, read_capture, true_fit

Fit = Mapping[str, NDArray[np.generic]]
OPAQUE = 250  # of 255: pixels on the true outline mix in the background
SURELY_SEEN = 0.9  # of 1: share of seen texels in what a bilinear lookup reads


def measure(capture: Capture, body: PackagedBody, config: TextureConfig, shift_m: float) -> dict[str, Any]:
    """Make one texture and compare it with the true pictures."""
    truth = true_fit(capture, body)
    noise = np.random.default_rng(0).normal(0, shift_m, truth["transl"].shape).astype(np.float32)
    fit = {**truth, "transl": truth["transl"].astype(np.float32) + noise}
    clock: list[Bill] = []
    with Meter() as meter:
        texture = build_texture(
            capture.frames, capture.visible, fit, body, config, lambda done, total: clock.append(meter.read())
        )
    bill = meter.read()
    # The first call ends a frame that includes what is prepared once, so the loop is measured from there on.
    per_frame = len(clock) / (len(clock) - 1) / len(capture.frames)
    cpu_s = (clock[-1].cpu_s - clock[0].cpu_s) * per_frame
    return {
        "capture": capture.folder.name,
        "mode": config.mode,
        "align_px": config.align_px,
        "seconds_per_frame": round((clock[-1].wall_s - clock[0].wall_s) * per_frame, 4),
        "cpu_seconds_per_frame": round(cpu_s, 4),
        "cpu_seconds_once": round(bill.cpu_s - cpu_s * len(capture.frames), 2),
        "peak_mb": bill.peak_rss_mb,
        "observed": round(texture.notes["observed_share"], 3),
        "mirrored": round(texture.notes["mirrored_share"], 3),
        "diffused": round(texture.notes["diffused_share"], 3),
        **colour_scores(capture, body, truth, texture),
    }


def colour_scores(capture: Capture, body: PackagedBody, fit: Fit, texture: Texture) -> dict[str, float]:
    """Look the texture up where the true pictures show the true body."""
    surface = Surface.of(body)
    seen_texels = pad_charts((texture.coverage > 0).astype(np.float32), texture.chart)
    front: list[NDArray[np.float64]] = []
    errors: list[NDArray[np.float64]] = []
    known: list[NDArray[np.bool_]] = []
    for frame in capture.scored_frames():
        vertices = posed_vertices(body, fit, frame)
        for name, camera in capture.cameras.items():
            truth = capture.truth(name, frame)
            caster = Caster(to_camera(vertices, camera.viewmats[0].numpy()), surface.faces)
            hits = hit_map(caster, camera.Ks[0].numpy(), camera.height, camera.width)
            where = (hits.face >= 0) & (truth[..., 3] > OPAQUE)
            where[where] = surface.textured[hits.face[where]]
            uv = interpolate_uv(surface, hits.face[where], hits.bary[where])
            error = sample_atlas(texture.filled_rgb, uv).astype(np.float64) - truth[where][:, :3]
            seen = sample_atlas(seen_texels, uv)
            errors.append(error)
            known.append(seen > 0.5)
            if name == "front":
                front.append(error[seen > SURELY_SEEN])
    every, is_seen = np.concatenate(errors), np.concatenate(known)
    return {
        "colour_error": round(float(np.abs(np.concatenate(front)).mean()), 1),
        "psnr_seen": round(_psnr(every[is_seen]), 2),
        "psnr_filled": round(_psnr(every[~is_seen]), 2),
    }


def _psnr(errors: NDArray[np.float64]) -> float:
    return float(10 * np.log10(255**2 / np.square(errors).mean()))


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", type=Path, help="folder of captures, laid out as their README says")
    parser.add_argument("--json", type=Path, default=None, help="file for the lines; they are printed in any case")
    parser.add_argument("--set", nargs="*", default=[], metavar="KNOB=VALUE", help="knobs of TextureConfig")
    parser.add_argument(
        "--shift-m", type=float, default=0.0, help="noise of the body's place, metres an axis and frame"
    )
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args(arguments)
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    torch.set_num_threads(options.threads)
    config = TextureConfig.model_validate_strings(dict(pair.split("=", 1) for pair in options.set))
    body = load_packaged_body()
    lines = [json.dumps({"machine": machine(), "set": options.set, "shift_m": options.shift_m})]
    for folder in capture_folders(options.captures):
        capture = read_capture(folder)
        for mode, align_px in product(("first", "best"), dict.fromkeys((config.align_px, 0.0))):
            setting = config.model_copy(update={"mode": mode, "align_px": align_px})
            lines.append(json.dumps(measure(capture, body, setting, options.shift_m)))
            print(lines[-1], flush=True)
    if options.json:
        options.json.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
