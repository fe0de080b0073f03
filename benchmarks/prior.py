"""The generative prior: `python -m benchmarks.prior CAPTURES_DIR --corpus SHARDS --json OUT`.

One JSON object. Held-out rendered people come from SHARDS (`ahoy prior corpus` makes them); captures from CAPTURES_DIR,
whose subjects and clothes are in no split of the corpus. PSNRs are means over pictures in dB (peak 1), inside the named
region alone; `gain` keys are differences in dB. `gradient` is gradient energy as a share of the truth's. Times are CPU
seconds of this process on `threads` threads; `machine` says on what, and how busy it was. `--parts` measures some of it
and leaves what else the file holds: a long benchmark can be had in pieces.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ahoy_core.body.packaged import PackagedBody, load_packaged_body
from ahoy_core.body.rotations import axis_angle_to_matrix
from ahoy_core.captures import Capture, View, read_dataset
from ahoy_core.captures.fit import posed_vertices, read_clip, true_fit, true_frames
from ahoy_core.conventions import Cameras
from ahoy_core.cost import machine
from ahoy_core.prior.bodymaps import light_maps
from ahoy_core.prior.canonical import CanonicalFill, check_prior
from ahoy_core.prior.config import IdentityConfig
from ahoy_core.prior.corpus.prompts import NEUTRAL
from ahoy_core.prior.corpus.wardrobe import SPLITS
from ahoy_core.prior.evaluate import held_out
from ahoy_core.prior.evidence import Frames
from ahoy_core.prior.framing import HEIGHT, WIDTH, framing_Ks
from ahoy_core.prior.identity_curve import Subject, generated, identity_curve
from ahoy_core.prior.light import brightness_on, lit, unlit
from ahoy_core.prior.scores import psnr
from ahoy_core.prior.subject import subject_frames
from ahoy_core.prior.video import VideoModel, load_video
from ahoy_core.texture.atlas import ObservedAtlas
from ahoy_core.texture.texture import Texture, TextureConfig, build_texture
from benchmarks.prior_curves import draw_curves, identity, solvers
from tasks.complete import CompleteConfig
from tasks.fills import Fills
from tasks.roles import perceptual_network

_CAMERAS = ("front", "left", "back", "right")
_BANDS = {"torso": (0.1, 0.6), "legs": (-0.85, -0.1)}  # of the body's height in [-1,1]
_IDENTITY_FRAMES = 12
_PARTS = ("held-out", "captures", "solvers", "identity")
_HELD_OUT = tuple(split for split in SPLITS if split != "train")


def static_views(capture: Capture, body: PackagedBody, brightness: NDArray[Any]) -> tuple[Frames, Tensor]:
    """The four cameras of the first scored frame, whole, as person images; and the light on them [4,1,H,W]."""
    fit, number = true_fit(capture, body), true_frames(capture)[0]
    vertices = torch.from_numpy(posed_vertices(body, fit, number))[None].expand(4, -1, -1)
    pictures = [capture.picture(View("view", name, number)) for name in _CAMERAS]
    views = [capture.cameras[name] for name in _CAMERAS]
    cameras = Cameras(
        torch.cat([view.viewmats for view in views]),
        torch.cat([view.Ks for view in views]),
        views[0].width,
        views[0].height,
    )
    root = axis_angle_to_matrix(torch.from_numpy(fit["pose"][number, 0])).expand(4, 3, 3)
    rgb, alpha = torch.stack([one.rgb for one in pictures]), torch.stack([one.alpha for one in pictures])
    Ks = framing_Ks(cameras.viewmats, vertices, HEIGHT, WIDTH, together=False)
    framed = Cameras(cameras.viewmats, Ks, WIDTH, HEIGHT)
    light = light_maps(body, vertices, framed, brightness)
    return subject_frames(rgb, alpha[:, None], cameras, body, vertices, root), light


def texture_of(capture: Capture, body: PackagedBody) -> Texture:
    """A capture's texture, from the true body."""
    clip = read_clip(capture)
    config = TextureConfig(atlas_size=256, frame_stride=4)
    return build_texture(clip.frames, clip.visible, true_fit(capture, body), body, config)


def light_of(capture: Capture, body: PackagedBody, texture: Texture) -> NDArray[Any]:
    """Brightness [V] of the light that its video tells of."""
    return brightness_on(body, true_fit(capture, body)["betas"], np.array(texture.notes["light"]))


def video_frames(capture: Capture, body: PackagedBody, brightness: NDArray[Any]) -> Frames:
    """Frames of the occluded video, evenly spread, as person images in even light."""
    fit, clip = true_fit(capture, body), read_clip(capture)
    numbers = torch.linspace(0, len(clip.frames) - 1, _IDENTITY_FRAMES).round().int().tolist()
    vertices = torch.stack([torch.from_numpy(posed_vertices(body, fit, n)) for n in numbers])
    front = capture.cameras["front"]
    count = len(numbers)
    cameras = Cameras(front.viewmats.expand(count, 4, 4), front.Ks.expand(count, 3, 3), front.width, front.height)
    root = axis_angle_to_matrix(torch.from_numpy(fit["pose"][numbers, 0]))
    images = torch.from_numpy(clip.frames[numbers]).permute(0, 3, 1, 2).float() / 255
    visible = torch.from_numpy(clip.visible[numbers])[:, None].float() / 255
    return subject_frames(images, visible, cameras, body, vertices, root, brightness=brightness)


def band_weight(views: Frames, name: str) -> Tensor:
    """[4,1,H,W] alpha of a band of the body's height."""
    assert views.body is not None
    height = views.body[:, 3] / views.body[:, 0].clamp(min=1e-3)
    low, high = _BANDS[name]
    inside = (height > low) & (height < high) & (views.body[:, 0] > 0.5)
    fine = inside.repeat_interleave(4, -1).repeat_interleave(4, -2)[:, None].float()
    return fine * views.visible


def colours(pictures: Tensor, weight: Tensor) -> Tensor:
    """Mean colour [3] under weights."""
    return (pictures * weight).sum((0, 2, 3)) / weight.sum().clamp(min=1)


def capture_subject(capture: Capture, body: PackagedBody, texture: Texture) -> Subject:
    """A capture's person: frames of the occluded video, and the four cameras, of which only the front one is shown."""
    brightness = light_of(capture, body, texture)
    views, light = static_views(capture, body, brightness)
    garments = {name: band_weight(views, name) for name in _BANDS}
    held_back = torch.tensor([name != "front" for name in _CAMERAS])
    return Subject(capture.name, video_frames(capture, body, brightness), views, garments, held_back, light)


def capture_figures(video: VideoModel, capture: Capture, body: PackagedBody) -> dict[str, Any]:
    """Front to the other three cameras, and garment colours before and after the identity fine-tuning."""
    texture = texture_of(capture, body)
    subject = capture_subject(capture, body, texture)
    views = subject.views
    even = replace(views, images=unlit(views.images, views.visible, subject.light))
    turned = lit(generated(video, even, NEUTRAL, front=True), views.visible, subject.light)
    mirror = views.images[:1].flip(-1).expand_as(views.images)
    flat = torch.full_like(views.images, 0.5)
    for name in _BANDS:
        weight = band_weight(views, name)
        flat = torch.where(weight > 0, colours(views.images[:1], weight[:1])[:, None, None], flat)
    found: dict[str, Any] = {
        "self_check": self_checked(video, capture, body, texture),
        "static_from_front": {},
    }
    for name in _BANDS:
        weight = band_weight(views, name)[1:]
        for label, made in (("prior", turned), ("mirror", mirror), ("colours", flat)):
            found["static_from_front"][f"{label}/{name}"] = float(psnr(made[1:], views.images[1:], weight).nanmean())
    config = IdentityConfig()
    rows = identity_curve(video, subject, (config.rank,), (config.steps,))
    found["identity"] = dict(zip(("before", "after"), rows, strict=True))
    return found


def self_checked(video: VideoModel, capture: Capture, body: PackagedBody, texture: Texture) -> dict[str, Any]:
    """The self-check on a capture's texture."""
    observed = ObservedAtlas(texture.observed_rgb, texture.coverage, texture.source_frame)
    fill = CanonicalFill(body, true_fit(capture, body)["betas"], observed)
    check = check_prior(video, fill, regions=CompleteConfig().regions)
    return {"errors": check.errors, "winner": check.winner, "regions": check.regions, "pixels": check.pixels}


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", type=Path)
    parser.add_argument("--prior", type=Path, required=True, help="folder of the prior")
    parser.add_argument("--corpus", type=Path, help="folder with held-out shards")
    parser.add_argument("--clips", type=int, default=24, help="held-out clips of each split")
    parser.add_argument("--splits", nargs="+", choices=_HELD_OUT, default=_HELD_OUT, help="held-out splits")
    parser.add_argument("--parts", nargs="+", choices=_PARTS, default=_PARTS, help="what to measure")
    parser.add_argument("--solver-clips", type=int, default=1, help="of each held-out split, for the part solvers")
    parser.add_argument("--people", type=int, default=1, help="of each held-out split, for the part identity")
    parser.add_argument("--plots", type=Path, help="folder for the curves' PNGs")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--json", type=Path, required=True)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    start = time.process_time()
    video = load_video(arguments.prior)
    loading = time.process_time() - start
    perceptual = perceptual_network(Fills())
    found: dict[str, Any] = json.loads(arguments.json.read_text(encoding="utf-8")) if arguments.json.exists() else {}
    found |= {
        "machine": machine(),
        "threads": arguments.threads,
        "prior_load_cpu_seconds": round(loading, 2),
    }
    if arguments.corpus is not None and "held-out" in arguments.parts:
        found["held_out"] = held_out(video, arguments.corpus, arguments.clips, arguments.splits, perceptual)
    if arguments.corpus is not None and "solvers" in arguments.parts:
        found["solvers"] = solvers(video, arguments.corpus, arguments.solver_clips, perceptual)
    captures = list(read_dataset(arguments.captures, "ours"))
    body = load_packaged_body()
    if "identity" in arguments.parts:
        people = [capture_subject(capture, body, texture_of(capture, body)) for capture in captures]
        found["identity"] = identity(video, arguments.corpus, people, arguments.people)
    if "captures" in arguments.parts:
        found["captures"] = {capture.name: capture_figures(video, capture, body) for capture in captures}
    if arguments.plots is not None:
        draw_curves(found, arguments.plots)
    arguments.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
