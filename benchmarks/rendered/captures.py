"""Writes a scene in the layout of our captures: the input, its masks, true pictures from four sides, true bodies."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import torch

from ahoy_core.body.convert import to_local_ref
from ahoy_core.body.packaged import PackagedBody
from ahoy_core.captures.body_errors import JOINTS24
from ahoy_core.formats.video_write import write_mp4
from benchmarks.rendered.people import Wardrobe
from benchmarks.rendered.render import Picture, View, render, render_alone
from benchmarks.rendered.scenes import FPS, Scene, sample_scene, sample_unseen, views_around

TRUTH_EVERY = 6
UNSEEN_FRAMES, UNSEEN_SHOWN = 48, 8  # of the motion that the input never shows
SEEN_SHARE = (0.35, 1.0)  # of the person: scenes outside are drawn again


def draw(scene: Scene, body: PackagedBody, frame: int) -> Picture:
    """One frame of a scene."""
    posed = scene.person.posed(body, scene.pose[frame], scene.transl[frame])
    return render([(scene.person, posed)], scene.boxes(frame), scene.view)


def seen_share(picture: Picture) -> float:
    """Share of the whole person, in the picture, that is visible."""
    return float(picture.visible.sum() / max(picture.amodal.sum(), 1.0))


def write_capture(folder: Path, seed: int, wardrobe: Wardrobe, frames: int) -> None:
    """Render a clip of one person and write it with its truth; the same seed gives the same input."""
    body, rng = wardrobe.body, np.random.default_rng(seed)
    scene = sample_scene(rng, wardrobe, frames, fine=1.5)
    while not SEEN_SHARE[0] < seen_share(draw(scene, body, frames // 2)) < SEEN_SHARE[1]:
        scene = sample_scene(rng, wardrobe, frames, fine=1.5)
    for name in ("vis", "amodal", "gt", "novel"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    pictures = [draw(scene, body, t) for t in range(frames)]
    for t, picture in enumerate(pictures):
        cv2.imwrite(str(folder / "vis" / f"{t:03d}.png"), picture.visible)
        if t % TRUTH_EVERY == 0:
            cv2.imwrite(str(folder / "amodal" / f"{t:03d}.png"), picture.amodal)
    noise = rng.normal(0, 2.5, (frames, *pictures[0].rgb.shape))
    noisy = np.clip(np.stack([p.rgb for p in pictures]) + noise, 0, 255).astype(np.uint8)
    write_mp4(folder / "front.mp4", noisy, FPS, crf=16)

    apart = np.random.default_rng([seed, 1])  # so that what came before, the input, does not depend on what follows
    unseen = sample_unseen(apart, scene, body, UNSEEN_FRAMES)
    shown = np.linspace(0, UNSEEN_FRAMES - 1, UNSEEN_SHOWN).round().astype(int).tolist()
    views = views_around(scene.view, apart)
    _write_true_pictures(folder / "gt", scene, body, views, {t: t for t in range(0, frames, TRUTH_EVERY)})
    _write_true_pictures(folder / "novel", unseen, body, views, dict(enumerate(shown)))
    _write_cameras(folder / "cameras.json", views)
    _write_motion(folder / "motion.npz", scene, body, list(range(frames)))
    _write_motion(folder / "novel_motion.npz", unseen, body, shown)
    facts = {**scene.facts, "unseen_motion": unseen.facts["motion"]}
    facts |= {"outfit": scene.person.outfit, "hair": scene.person.hair}
    (folder / "info.json").write_text(json.dumps(facts), encoding="utf-8")


def _write_true_pictures(
    folder: Path, scene: Scene, body: PackagedBody, views: dict[str, View], frames: dict[int, int]
) -> None:
    """Pictures of all cameras; `frames`: number in the file's name -> frame of the scene."""
    for number, frame in frames.items():
        posed = scene.person.posed(body, scene.pose[frame], scene.transl[frame])
        for name, view in views.items():
            rgba = render_alone(scene.person, posed, scene.boxes(frame), view)
            cv2.imwrite(str(folder / f"{name}_{number:03d}.png"), rgba[..., [2, 1, 0, 3]])


def _write_cameras(path: Path, views: dict[str, View]) -> None:
    cameras = {
        name: {
            "K": view.K.tolist(), "R": view.viewmat[:3, :3].tolist(), "t": view.viewmat[:3, 3].tolist(),
            "width": view.width, "height": view.height,
        }
        for name, view in views.items()
    }  # fmt: skip
    path.write_text(json.dumps({"fps": FPS, "cameras": cameras}), encoding="utf-8")


def _write_motion(path: Path, scene: Scene, body: PackagedBody, frames: list[int]) -> None:
    betas, pose, transl = scene.person.betas, scene.pose[frames], scene.transl[frames]
    with torch.no_grad():
        joints = torch.cat([body(p[None], betas[None], t[None]).joints for p, t in zip(pose, transl, strict=True)])
    rows = [body.joint_names.index(name) for name in JOINTS24.values()]
    np.savez_compressed(
        path,
        pose_local_ref=to_local_ref(body, pose, transl, betas).numpy(),
        phenotype=json.dumps(dict(zip(body.beta_names, betas.tolist(), strict=True))),
        joints24=joints[:, rows].numpy(),
        joints24_names=np.array(list(JOINTS24)),
    )
