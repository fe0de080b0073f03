"""The coarse avatar of captures whose truth is known: `python -m benchmarks.avatar CAPTURES_DIR --json OUT`.

Pose, camera and visible mask are the true ones, so what is measured is texture and training, not perception. One JSON
line per capture, after one that names the machine. `psnr_novel_view` and `iou` are means over the four true cameras and
all their frames: the whole clothed person, hidden parts too, in the box of the true alpha, over grey 0.5.
`psnr_held_out` is that of the frame that training never saw, under the protocol `input-view`; `..._template` is the
textured body before training. `seconds`, `cpu_seconds` and `peak_mb` are those of the training
(the peak of the whole process).
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ahoy_core.avatar.avatar import Avatar, AvatarInfo
from ahoy_core.avatar.coarse import train_coarse
from ahoy_core.avatar.render import render
from ahoy_core.avatar.supervision import CoarseInputs
from ahoy_core.body.packaged import PackagedBody, load_packaged_body
from ahoy_core.conventions import GREY, OBSERVED_VIEWMAT, Cameras
from ahoy_core.cost import Meter, machine
from ahoy_core.formats.images import to_float
from ahoy_core.metrics import iou, psnr
from ahoy_core.metrics.regions import mask_box
from ahoy_core.perceive.masks import silhouette
from ahoy_core.texture.texture import Texture, build_texture
from benchmarks.captures import Capture, capture_folders, posed_vertices, read_capture, true_fit
from tasks.presets import PRESETS
from tasks.settings import Settings

Fit = Mapping[str, NDArray[np.generic]]


def measure(capture: Capture, body: PackagedBody, settings: Settings, config: str) -> dict[str, Any]:
    """Train on one capture and score the result."""
    fit = true_fit(capture, body)
    texture = build_texture(capture.frames, capture.visible, fit, body, settings.texture)
    inputs = coarse_inputs(capture, body, fit, texture)
    with Meter() as meter:
        result = train_coarse(inputs, settings.coarse, AvatarInfo(body=body.name))
    bill, held_out = meter.read(), result.held_out
    scores = {name: view_scores(capture, body, fit, result.avatar, name) for name in capture.cameras}
    mean = np.mean(list(scores.values()), axis=0)
    return {
        "capture": capture.folder.name,
        "config": config,
        "psnr_novel_view": round(float(mean[0]), 2),
        "psnr_held_out": round(held_out.psnr_after, 2) if held_out else None,
        "iou": round(float(mean[1]), 4),
        "seconds": round(bill.wall_s, 1),
        "cpu_seconds": round(bill.cpu_s, 1),
        "peak_mb": bill.peak_rss_mb,
        "psnr_held_out_template": round(held_out.psnr_before, 2) if held_out else None,
        "ssim_held_out": round(held_out.ssim_after, 3) if held_out else None,
        "ssim_held_out_template": round(held_out.ssim_before, 3) if held_out else None,
        "by_camera": {name: {"psnr": round(p, 2), "iou": round(i, 4)} for name, (p, i) in scores.items()},
        "gaussians": len(result.avatar),
        "steps": len(result.losses),
    }


def coarse_inputs(capture: Capture, body: PackagedBody, fit: Fit, texture: Texture) -> CoarseInputs:
    """What the stages before would hand to the training."""
    views = to_float(texture.views)
    viewmats, Ks = torch.from_numpy(texture.viewmats), torch.from_numpy(texture.Ks)
    arrays = {name: torch.from_numpy(fit[name]) for name in ("betas", "pose", "transl", "viewmat", "K", "used")}
    return CoarseInputs(
        body=body,
        **arrays,
        frames=torch.from_numpy(np.ascontiguousarray(np.moveaxis(capture.frames, -1, 1))),
        masks=torch.from_numpy(capture.visible),
        silhouettes=torch.from_numpy(
            np.stack([_silhouette(body, fit, t, capture) for t in range(len(capture.frames))])
        ),
        confidence=torch.from_numpy(fit["frame_confidence"]),
        views=views,
        view_coverage=torch.from_numpy(texture.view_coverage).float() / 255,
        view_cameras=Cameras(viewmats, Ks, views.shape[3], views.shape[2], "ortho"),
        atlas=to_float(texture.filled_rgb),
        atlas_coverage=torch.from_numpy(texture.coverage),
    )


def _silhouette(body: PackagedBody, fit: Fit, frame: int, capture: Capture) -> NDArray[np.uint8]:
    """Alpha [H,W] of the fitted body; it is turned in front of the camera that `silhouette` assumes."""
    viewmat = fit["viewmat"].astype(np.float32)
    seen = posed_vertices(body, fit, frame) @ viewmat[:3, :3].T + viewmat[:3, 3]
    turned = seen @ OBSERVED_VIEWMAT.numpy()[:3, :3]
    height, width = capture.frames.shape[1:3]
    return silhouette(turned, body.faces.numpy(), fit["K"].astype(np.float32), height, width)


@torch.no_grad()
def view_scores(capture: Capture, body: PackagedBody, fit: Fit, avatar: Avatar, camera: str) -> tuple[float, float]:
    """PSNR and silhouette IoU from one camera, each the mean over its true frames."""
    scores = []
    for frame in capture.scored_frames():
        truth = to_float(capture.truth(camera, frame))
        alpha = truth[3]
        posed = avatar.pose(body, torch.from_numpy(fit["pose"][frame]), torch.from_numpy(fit["transl"][frame]))
        made = render(posed.means, posed.covars, posed.opacities, posed.colors, capture.cameras[camera], GREY)
        x0, y0, x1, y1 = mask_box(alpha)
        target = truth[:3] * alpha + GREY * (1 - alpha)
        image = made.images[0].clamp(0, 1)
        scores.append((psnr(image[:, y0:y1, x0:x1], target[:, y0:y1, x0:x1]), iou(made.alphas[0, 0], alpha)))
    mean = np.mean(scores, axis=0)
    return float(mean[0]), float(mean[1])


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", type=Path, help="folder of captures, laid out as their README says")
    parser.add_argument("--json", type=Path, default=None, help="file for the lines; they are printed in any case")
    parser.add_argument("--preset", choices=["draft", "standard"], default="draft")
    parser.add_argument("--set", nargs="*", default=[], metavar="STAGE.KNOB=VALUE", help="as in `ahoy run`")
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args(arguments)
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    torch.set_num_threads(options.threads)
    settings = PRESETS[options.preset].with_overrides(options.set)
    body = load_packaged_body()
    lines = [json.dumps({"machine": machine(), "threads": options.threads})]
    for folder in capture_folders(options.captures):
        row = measure(read_capture(folder), body, settings, " ".join([options.preset, *options.set]))
        lines.append(json.dumps(row))
        print(lines[-1], flush=True)
    if options.json:
        options.json.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
