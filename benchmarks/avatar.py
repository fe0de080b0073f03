"""The avatars of captures whose truth is known: `python -m benchmarks.avatar CAPTURES_DIR --json OUT`.

Pose, camera and visible mask are the true ones, so what is measured is training, not perception. One JSON line per
capture and configuration, after one that names the machine:

- `upper`: the full avatar on the true pictures of all cameras at frames 0, 12, 24, 36 (what it can hold at all);
- `upper-CAMERA`: the same without that camera, which alone is scored as the novel view;
- `full`, `C1`, `C2`, `C`, `C3`, `D`: observed video, and those pictures made inconsistent as a generator's
  (benchmarks/avatar_supervision.py states the amounts), under the switches of the ablation;
- `coarse` (= `A`): the coarse avatar from the video alone.

`psnr_novel_view` is over frames 6, 18, 30, 42 of all cameras, `psnr_novel_pose` over the unseen motion, `psnr_head`
over the head's box of the former, means of pictures; by the renderer and the metrics of `ahoy evaluate` (regions `box`
and `head` of docs/metrics.md), without its rounding to 8 bits. `seconds`, `cpu_seconds` and `peak_mb` (of the process)
are those of the training; `fps` is posing and rendering one frame of the unseen motion at that size, every pose new.
`held_out` is the score under `input-view`.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ahoy_core.avatar import AvatarInfo, train_coarse, train_full
from ahoy_core.avatar.avatar import Avatar
from ahoy_core.avatar.coarse import textured_template
from ahoy_core.avatar.full_config import ABLATIONS, FullConfig
from ahoy_core.avatar.full_inputs import FullInputs
from ahoy_core.avatar.kinematics import Kinematics
from ahoy_core.avatar.render import render
from ahoy_core.avatar.supervision import CoarseInputs
from ahoy_core.body.packaged import PackagedBody, load_packaged_body
from ahoy_core.captures import Capture, View, read_dataset
from ahoy_core.captures.fit import Clip, Fit, posed_vertices, read_clip, true_fit
from ahoy_core.conventions import OBSERVED_VIEWMAT, Cameras
from ahoy_core.cost import Meter, machine
from ahoy_core.formats.images import to_float
from ahoy_core.maps.template import Template
from ahoy_core.perceive.masks import silhouette
from ahoy_core.texture.texture import Texture, build_texture
from benchmarks.avatar_supervision import TESTED, inconsistent, true_faces, true_sequences
from tasks.evaluation.scoring import AvatarScores, score_avatar
from tasks.fills import Fills
from tasks.presets import PRESETS
from tasks.roles import perceptual_network
from tasks.settings import Settings

CAMERAS = ("front", "left", "back", "right")
CONFIGS = ("upper", *(f"upper-{name}" for name in CAMERAS), "coarse", "full", "C1", "C2", "C", "C3", "D")


class Subject:
    """One capture with what every configuration starts from."""

    def __init__(self, capture: Capture, body: PackagedBody, settings: Settings) -> None:
        self.capture, self.body, self.settings = capture, body, settings
        clip, self.fit = read_clip(capture), true_fit(capture, body)
        texture = build_texture(clip.frames, clip.visible, self.fit, body, settings.texture)
        self.inputs = coarse_inputs(clip, body, self.fit, texture)
        self.template: Template = textured_template(self.inputs, settings.coarse.map_size)
        novel = true_fit(self.capture, body, "pose")
        self.novel = torch.from_numpy(novel["pose"]), torch.from_numpy(novel["transl"])

    def full_inputs(self, config: str) -> FullInputs:
        """What the full avatar is trained on under a configuration."""
        cameras = tuple(name for name in CAMERAS if config != f"upper-{name}")
        sequences = true_sequences(self.capture, self.inputs.pose, self.inputs.transl, cameras)
        kinematics = Kinematics.of(self.body, self.inputs.betas)
        if config.startswith("upper"):
            unseen = dict.fromkeys(("used",), torch.zeros_like(self.inputs.used))
            observed = CoarseInputs(**{**vars(self.inputs), **unseen})
            return FullInputs(observed, self.template, sequences=sequences)
        faces = true_faces(sequences, self.template, kinematics, self.body.n_expressions)
        jittered = inconsistent(sequences, self.body, self.template, self.inputs.betas, seed=0)
        return FullInputs(self.inputs, self.template, sequences=jittered, faces=faces)


def measure(subject: Subject, config: str, sheets: Path | None) -> dict[str, Any]:
    """Train under one configuration and score."""
    settings = subject.settings.avatar
    if config in ABLATIONS:
        settings = settings.model_copy(update={"switches": ABLATIONS[config]})
    elif config.startswith("upper"):
        settings = upper_bound(settings)
    info = AvatarInfo(body=subject.body.name)
    facts: dict[str, Any] = {}
    with Meter() as meter:
        if config == "coarse":
            result = train_coarse(subject.inputs, subject.settings.coarse, info, perceptual=perceptual_network(Fills()))
        else:
            made = train_full(subject.full_inputs(config), settings, info, perceptual=perceptual_network(Fills()))
            result = made
            facts = {"corrections": {name: round(value, 3) for name, value in made.corrections.items()}}
    bill = meter.read()
    held_out = result.held_out
    cameras = (config.removeprefix("upper-"),) if config.startswith("upper-") else CAMERAS
    view, pose = _scored(subject, result.avatar, cameras, sheets, config)
    return {
        "capture": subject.capture.name,
        "config": config,
        "psnr_novel_view": round(view.psnr, 2),
        "psnr_novel_pose": round(pose.psnr, 2),
        "psnr_head": round(view.psnr_head, 2),
        "seconds": round(bill.wall_s, 1),
        "cpu_seconds": round(bill.cpu_s, 1),
        "fps": _fps(subject, result.avatar),
        "peak_mb": bill.peak_rss_mb,
        "iou_novel_view": round(view.iou, 4),
        "iou_novel_pose": round(pose.iou, 4),
        "psnr_head_novel_pose": round(pose.psnr_head, 2),
        "held_out": [round(held_out.psnr_before, 2), round(held_out.psnr_after, 2)] if held_out else None,
        "gaussians": len(result.avatar),
        "steps": len(result.losses),
        "notes": list(result.notes),
        **facts,
    }


def upper_bound(config: FullConfig) -> FullConfig:
    """True supervision has nothing to correct and nothing to keep from the head."""
    switches = config.switches.model_copy(update={"corrections": False, "head_split": False})
    return config.model_copy(update={"switches": switches})


def _scored(
    subject: Subject, avatar: Avatar, cameras: Sequence[str], sheets: Path | None, config: str
) -> tuple[AvatarScores, AvatarScores]:
    capture, body = subject.capture, subject.body
    name = f"{capture.name}_{config}"
    paths = (None, None) if sheets is None else (sheets / f"{name}_view.png", sheets / f"{name}_pose.png")
    seen = [View("view", camera, frame) for frame in TESTED for camera in cameras]
    unseen = [view for view in capture.of("pose") if view.camera in cameras]
    return (
        score_avatar(avatar, body, capture, seen, sheet=paths[0]),
        score_avatar(avatar, body, capture, unseen, sheet=paths[1]),
    )


@torch.no_grad()
def _fps(subject: Subject, avatar: Avatar) -> float:
    """Frames a CPU-second, posing included, every pose a new one."""
    camera = subject.capture.cameras["front"]
    start = time.process_time()
    for pose, place in zip(*subject.novel, strict=True):
        posed = avatar.pose(subject.body, pose, place)
        render(posed.means, posed.covars, posed.opacities, posed.colors, camera)
    return round(len(subject.novel[0]) / (time.process_time() - start), 1)


def coarse_inputs(clip: Clip, body: PackagedBody, fit: Fit, texture: Texture) -> CoarseInputs:
    """What the stages before would hand to the training."""
    views = to_float(texture.views)
    viewmats, Ks = torch.from_numpy(texture.viewmats), torch.from_numpy(texture.Ks)
    arrays = {name: torch.from_numpy(fit[name]) for name in ("betas", "pose", "transl", "viewmat", "K", "used")}
    return CoarseInputs(
        body=body,
        **arrays,
        frames=torch.from_numpy(np.ascontiguousarray(np.moveaxis(clip.frames, -1, 1))),
        masks=torch.from_numpy(clip.visible),
        silhouettes=torch.from_numpy(np.stack([_silhouette(body, fit, t, clip) for t in range(len(clip.frames))])),
        confidence=torch.from_numpy(fit["frame_confidence"]),
        views=views,
        view_coverage=torch.from_numpy(texture.view_coverage).float() / 255,
        view_cameras=Cameras(viewmats, Ks, views.shape[3], views.shape[2], "ortho"),
        atlas=to_float(texture.filled_rgb),
        atlas_coverage=torch.from_numpy(texture.coverage),
    )


def _silhouette(body: PackagedBody, fit: Fit, frame: int, clip: Clip) -> NDArray[np.uint8]:
    """Alpha [H,W] of the fitted body; it is turned in front of the camera that `silhouette` assumes."""
    viewmat = fit["viewmat"].astype(np.float32)
    seen = posed_vertices(body, fit, frame) @ viewmat[:3, :3].T + viewmat[:3, 3]
    turned = seen @ OBSERVED_VIEWMAT.numpy()[:3, :3]
    height, width = clip.frames.shape[1:3]
    return silhouette(turned, body.faces.numpy(), fit["K"].astype(np.float32), height, width)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", type=Path, help="folder of captures, laid out as their README says")
    parser.add_argument("--json", type=Path, default=None, help="file for the lines; they are printed in any case")
    parser.add_argument("--preset", choices=["draft", "standard"], default="draft")
    parser.add_argument("--configs", nargs="*", default=list(CONFIGS), choices=CONFIGS)
    parser.add_argument("--only", default=None, help="name of one capture")
    parser.add_argument("--set", nargs="*", default=[], metavar="STAGE.KNOB=VALUE", help="as in `ahoy run`")
    parser.add_argument("--sheets", type=Path, default=None, help="folder for pictures of truth and render")
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args(arguments)
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    torch.set_num_threads(options.threads)
    settings = PRESETS[options.preset].with_overrides(options.set)
    body = load_packaged_body()
    if options.sheets is not None:
        options.sheets.mkdir(parents=True, exist_ok=True)
    lines = [json.dumps({"machine": machine(), "threads": options.threads, "preset": options.preset})]
    for capture in read_dataset(options.captures, "ours"):
        if options.only not in (None, capture.name):
            continue
        subject = Subject(capture, body, settings)
        for config in options.configs:
            lines.append(json.dumps({**measure(subject, config, options.sheets), "set": options.set}))
            print(lines[-1], flush=True)
            if options.json:
                options.json.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
