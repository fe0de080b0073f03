"""Frames of a 40,000-Gaussian avatar in a scene of 200,000: `python -m benchmarks.render --json OUT`.

One JSON line a case, after one that names the machine: what `auto` turned on, estimated and measured CPU-seconds of
each part, frames a second on two cores (two frames at a time, wall clock, so only meaningful on an idle machine) and as
CPU time allows (`cpu_fps`, 2 / CPU-seconds of a frame). Cases: `none` and `auto` where nothing is called for (a wall
behind a person who stands still), and in the furnished room. `--fit` measures the rasterizer's coefficients anew.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import nnls
from torch import Tensor

from ahoy_core.avatar.avatar import Avatar, AvatarInfo, bake, network_config
from ahoy_core.avatar.deform import OffsetBounds, offset_channels
from ahoy_core.body.canonical import canonical_pose
from ahoy_core.body.packaged import load_packaged_body
from ahoy_core.conventions import Cameras, look_at, perspective_K
from ahoy_core.cost import machine
from ahoy_core.maps.style_unet import StyleUNet
from ahoy_core.maps.template import build_template
from ahoy_core.motion import load_motion, placed
from ahoy_core.scene.cost import Rates, calibrate, raster_load, rasterize
from ahoy_core.scene.plan import BASE, Request, plan_effects
from ahoy_core.scene.puppet import Puppet
from ahoy_core.scene.render import Stage
from ahoy_core.scene.room import make_room
from ahoy_core.scene.scene import Scene, make_scene
from ahoy_core.scene.shot import Shot
from ahoy_core.splat import Gaussians

SIZE, FPS = 512, 12.0
AVATAR_GAUSSIANS, SCENE_PITCH = 40_000, 0.0178


def person(count: int) -> Avatar:
    """The default body in grey with exactly `count` Gaussians: a template's, repeated."""
    body = load_packaged_body()
    start = build_template(body, body.default_betas, 128)
    network = StyleUNet(network_config(start, 4, offset_channels(start)), torch.Generator().manual_seed(0))
    made = bake(
        start, network, OffsetBounds(), body.default_betas, canonical_pose(body)[None], AvatarInfo(body=body.name)
    )
    rows = torch.arange(count) % len(made)
    per_row = {f.name: getattr(start, f.name) for f in fields(start)}
    wide = {n: v[rows] for n, v in per_row.items() if isinstance(v, Tensor) and len(v) == len(made)}
    template = replace(start, **wide)
    names = ("means", "quats", "scales", "opacities", "colors", "skin_weights")
    return replace(made, template=template, **{name: getattr(made, name)[rows] for name in names})


def wall(count: int) -> Scene:
    """A grey wall 1.5 m behind the origin."""
    side = math.isqrt(count)
    steps = torch.linspace(-2.5, 2.5, side)
    x, z = torch.meshgrid(steps, steps + 1, indexing="ij")
    means = torch.stack([x.reshape(-1), torch.full((x.numel(),), 1.5), z.reshape(-1)], 1)
    n, pitch = len(means), 5.0 / side
    upright = torch.tensor([math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0]).expand(n, 4).contiguous()
    scales = (pitch * torch.tensor([0.6, 0.6, 0.06])).expand(n, 3).contiguous()
    gaussians = Gaussians(means, upright, scales, torch.full((n,), 0.95), torch.full((n, 3), 0.5))
    return make_scene(gaussians, name="wall", up=torch.tensor([0.0, 0.0, 1.0]), metres_per_unit=1.0)


def measure(name: str, scene: Scene, puppet: Puppet, shot: Shot, effects: str, rates: Rates) -> dict[str, Any]:
    """Plan and render one case."""
    start = time.process_time()
    plan = plan_effects(scene, [puppet], shot, Request(effects, rates))  # type: ignore[arg-type]
    planning = time.process_time() - start
    stage = Stage(scene, (puppet,), shot, plan)
    wall_start = time.perf_counter()
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(stage.picture, range(plan.frames)))
    wall_s = time.perf_counter() - wall_start
    measured = sum(stage.ledger.seconds.values())
    base = plan.base_seconds - plan.frames * SIZE * SIZE * rates.write  # pictures are not stored here
    estimated = plan.seconds - plan.frames * SIZE * SIZE * rates.write
    parts = {
        e.name: (round(e.seconds, 3), round(stage.ledger.seconds.get(e.name, 0.0), 3)) for e in plan.effects if e.on
    }
    return {
        "case": name,
        "effects": effects,
        "on": [e.name for e in plan.effects if e.on],
        "frames": plan.frames,
        "planning_cpu_s": round(planning, 3),
        "estimated_cpu_s": round(estimated, 3),
        "measured_cpu_s": round(measured, 3),
        "ratio": round(measured / estimated, 3),
        "cpu_fps": round(2 * plan.frames / measured, 2),
        "wall_fps": round(plan.frames / wall_s, 2),
        "parts": {**parts, BASE: (round(base, 3), round(stage.ledger.seconds.get(BASE, 0.0), 3))},
    }


def fit() -> dict[str, Any]:
    """Coefficients by non-negative least squares: the rasterizer's over rooms and people, and of posing a person."""
    body, loads, seconds, posing = load_packaged_body(), [], [], []
    views = [_camera((1.2, -4.4, 1.7), (0.0, 0.3, 0.85), size) for size in (512, 256)]
    views.append(_camera((0.0, -2.0, 1.2), (0.0, 0.3, 0.85), 256))
    for pitch in (0.08, 0.045, 0.025, SCENE_PITCH):
        scene = make_room(pitch)
        g = scene.gaussians
        for cameras in views:
            loads.append(raster_load(g.means, scene.covars, g.opacities, cameras))
            seconds.append(_fastest(partial(rasterize, g.means, scene.covars, g.opacities, g.colors, cameras)))
    for count in (5_000, 20_000, AVATAR_GAUSSIANS):
        who = person(count)
        clip = load_motion("walk", body, who.betas, FPS, 2)
        posing.append((1.0, float(count), _fastest(partial(who.pose, body, clip.pose[0], clip.transl[0]))))
        p = who.pose(body, clip.pose[0], clip.transl[0])
        for cameras in views:
            loads.append(raster_load(p.means, p.covars, p.opacities, cameras))
            seconds.append(_fastest(partial(rasterize, p.means, p.covars, p.opacities, p.colors, cameras)))
    rates, ratios = _solve(np.array(loads), np.array(seconds))
    (skin, pose), of_posing = _solve(np.array(posing)[:, :2], np.array(posing)[:, 2])
    names = ("gaussian", "visible", "intersection", "pixel", "skin", "pose")
    calibrated = calibrate().gaussian / Rates().gaussian
    return {
        "fit": {name: float(value / calibrated) for name, value in zip(names, (*rates, skin, pose), strict=True)},
        "machine_factor": calibrated,
        "estimate_over_measured": [round(float(r), 3) for r in (*ratios, *of_posing)],
    }


def _fastest(work: Callable[[], Any], runs: int = 7) -> float:
    """CPU-seconds of the fastest run; other work only ever slows one down."""
    times = []
    for _ in range(runs):
        start = time.thread_time()
        work()
        times.append(time.thread_time() - start)
    return min(times)


def _solve(rows: NDArray[np.float64], took: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rates whose relative errors are least, and estimate over measured of each row."""
    found, _ = nnls(rows / took[:, None], np.ones(len(took)))
    return found, rows @ found / took


def _camera(eye: tuple[float, float, float], to: tuple[float, float, float], size: int) -> Cameras:
    view = look_at(torch.tensor(eye), torch.tensor(to))
    return Cameras(view[None], perspective_K(0.75, size, size)[None], size, size)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, default=None, help="file for the lines; they are printed in any case")
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--fit", action="store_true", help="fit the rasterizer's coefficients, and stop")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    lines = [json.dumps({"machine": machine()})]
    if options.fit:
        lines.append(json.dumps(fit()))
        print(lines[-1])
    else:
        body, who, rates = load_packaged_body(), person(AVATAR_GAUSSIANS), calibrate()
        room, plain = make_room(SCENE_PITCH), wall(200_000)
        rest = Puppet(who, body, load_motion("still", body, who.betas, FPS, 1)).rest[0]
        for name, scene, motion, shutter in (
            ("plain", plain, "still", 0.0),
            ("room", room, "walk", 0.0),
            ("room, blurred", room, "walk", 0.5),
        ):
            clip = load_motion(motion, body, who.betas, FPS, options.frames)
            puppet = Puppet(who, body, placed(clip, torch.tensor([-0.5, 0.7, 0.0]), 0.4, rest))
            shot = Shot(_camera((1.2, -4.4, 1.7), (0.0, 0.3, 0.85), SIZE), FPS, shutter)
            for effects in ("none", "auto"):
                lines.append(
                    json.dumps({**measure(name, scene, puppet, shot, effects, rates), "scene_gaussians": len(scene)})
                )
                print(lines[-1], flush=True)
    if options.json:
        options.json.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
