"""What perception finds on captures whose truth is known: `python -m benchmarks.perceive CAPTURES_DIR --json OUT`.

One JSON line per capture: the errors of `ahoy_core.captures.body_errors`, and `texel_l1`, the mean absolute colour
difference, of 255, between texels that were seen, textured through our fit and mask, and the true pictures, looked up
through the true body. Seconds are CPU seconds of perception, on one thread unless told. Knobs are swept by `ahoy cost`.

The capture's own camera is given to the method: intrinsics and, unless `--intrinsics-only`, where it stands.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ahoy_core.body.packaged import PackagedBody, load_packaged_body
from ahoy_core.captures import Capture, read_dataset
from ahoy_core.captures.body_errors import body_errors
from ahoy_core.captures.fit import Clip, read_clip, true_fit, true_frames
from ahoy_core.captures.texture_errors import texture_errors
from ahoy_core.cost import Meter
from ahoy_core.perceive.networks import Networks
from ahoy_core.perceive.perceive import PerceiveConfig, Perception, perceive
from ahoy_core.texture.inputs import TextureConfig
from ahoy_core.texture.texture import build_texture
from tasks.roles import landmark_networks


def measure(
    capture: Capture,
    body: PackagedBody,
    networks: Networks,
    config: PerceiveConfig,
    stands: bool = True,
    texels: bool = True,
) -> dict[str, Any]:
    """Perceive one capture and compare; `stands`: tell where the camera stands; `texels`: texture it too."""
    clip = read_clip(capture)
    n = len(clip.frames)
    front = capture.cameras[capture.input_camera]
    K, view = front.Ks[0].double().numpy(), front.viewmats[0].double().numpy()
    with Meter() as meter:
        found = perceive(
            clip.frames,
            clip.times,
            np.zeros(n, np.int32),
            K,
            body,
            networks,
            config,
            viewmat=view if stands else None,
        )
    bill = meter.read()
    return {
        "capture": capture.name,
        **body_errors(capture, clip, body, vars(found)),
        "texel_l1": _texel_error(capture, clip, body, found) if texels else None,
        "seconds_per_frame": round(bill.cpu_s / n, 4),
        "peak_mb": bill.peak_rss_mb,
        "landmark_error_mm": round(found.notes["landmark_error_m"] * 1000, 1),
        "betas": found.notes["betas"],
    }


def _texel_error(capture: Capture, clip: Clip, body: PackagedBody, found: Perception) -> float | None:
    """See the module's text; None for captures without true pictures."""
    if not true_frames(capture):
        return None
    names = ("pose", "transl", "betas", "expression", "joint_confidence", "frame_confidence", "used", "viewmat", "K")
    fit = {name: getattr(found, name) for name in names}
    texture = build_texture(clip.frames, found.visible, fit, body, TextureConfig())
    errors = texture_errors(capture, body, true_fit(capture, body), texture.atlas_arrays())
    return float(errors["texel_l1"])


def mean_line(lines: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Means over captures of every number, under the capture's name "mean"."""
    keys = [k for k, v in lines[0].items() if isinstance(v, (int, float)) or v is None]
    known = {k: [line[k] for line in lines if line[k] is not None] for k in keys}
    return {"capture": "mean", **{k: round(float(np.mean(v)), 4) if v else None for k, v in known.items()}}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", type=Path, help="folder of captures, laid out as their README says")
    parser.add_argument("--json", type=Path, default=None, help="file for the lines; they are printed in any case")
    parser.add_argument("--set", nargs="*", default=[], metavar="KNOB=VALUE", help="knobs of PerceiveConfig")
    parser.add_argument("--intrinsics-only", action="store_true", help="do not tell where the camera stands")
    parser.add_argument("--no-texels", action="store_true", help="leave texel_l1 out, which takes longer than the rest")
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    torch.set_num_threads(arguments.threads)
    config = PerceiveConfig.model_validate_strings(dict(pair.split("=", 1) for pair in arguments.set))
    body, networks = load_packaged_body(), landmark_networks(config.model, arguments.threads)
    lines = []
    for capture in read_dataset(arguments.captures, "ours"):
        lines.append(measure(capture, body, networks, config, not arguments.intrinsics_only, not arguments.no_texels))
        print(json.dumps(lines[-1]), flush=True)
    print(json.dumps(mean_line(lines)), flush=True)
    if arguments.json:
        arguments.json.write_text("".join(json.dumps(line) + "\n" for line in lines), encoding="utf-8")


if __name__ == "__main__":
    main()
