"""What the rasterizer's accuracy costs: each threshold swept, error against the float64 oracle beside time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor

from ahoy_core.cost import sweep
from ahoy_core.splat import oracle, rasterization
from benchmarks.scenes import Scene, SceneSpec, make_scene

SPEC = SceneSpec("2k@128", 2_000, 128, 6.0)  # small enough for the dense oracle, as crowded per pixel as the large ones
ALPHA_MAX = 0.999  # gsplat's clamps are part of the model, not shortcuts: the reference has them too
NO_THRESHOLDS = {"alpha_cutoff": 1e-7, "transmittance_stop": 1e-12}  # so that rounding alone is left


@dataclass(frozen=True)
class Sweep:
    """One knob of `rasterization` and the values it is tried at."""

    knob: str
    values: tuple[Any, ...]


SWEEPS = (
    Sweep("alpha_cutoff", (1 / 64, 1 / 128, 1 / 255, 1 / 512, 1 / 1024, 1 / 4096)),
    Sweep("transmittance_stop", (1e-2, 1e-3, 1e-4, 1e-5, 1e-6)),
    Sweep("radius_clip", (0.0, 1.0, 2.0, 4.0)),
    Sweep("tile_size", (8, 16, 32)),
    Sweep("dtype", ("float32", "float64")),
)


def accuracy_rows(knob: Sweep) -> list[dict[str, Any]]:
    """Measure one knob; the reference has no cutoff, no stop and no radius rule, but gsplat's clamps."""
    scene = make_scene(SPEC)
    reference = _reference(scene)

    def run(setting: Mapping[str, Any]) -> tuple[Tensor, list[Tensor]]:
        knobs = dict(setting)
        dtype = getattr(torch, knobs.pop("dtype", "float32"))
        inputs = _leaves(scene, dtype)
        image, _, _ = rasterization(
            *inputs, scene.Ks.to(dtype), SPEC.size, SPEC.size, backgrounds=scene.backgrounds.to(dtype), **knobs
        )
        image.backward(scene.v_render.to(dtype))
        return image.detach(), [value.grad for value in inputs if value.grad is not None]

    def error(result: tuple[Tensor, list[Tensor]]) -> dict[str, float]:
        image, grads = result
        relative = [float((a.double() - b).norm() / b.norm()) for a, b in zip(grads, reference[1], strict=True)]
        return {"image_rms": float((image.double() - reference[0]).square().mean().sqrt()), "gradient": max(relative)}

    settings = [{knob.knob: value} | (NO_THRESHOLDS if knob.knob == "dtype" else {}) for value in knob.values]
    return [asdict(row) for row in sweep(f"raster.{knob.knob}", settings, run, error, repeats=9)]


def _leaves(scene: Scene, dtype: torch.dtype) -> list[Tensor]:
    values = (scene.means, scene.quats, scene.scales, scene.opacities, scene.colors, scene.viewmats)
    return [value.to(dtype).clone().requires_grad_() for value in values]


def _reference(scene: Scene) -> tuple[Tensor, list[Tensor]]:
    inputs = _leaves(scene, torch.float64)
    image, _ = oracle.render(
        *inputs,
        scene.Ks.double(),
        SPEC.size,
        SPEC.size,
        backgrounds=scene.backgrounds.double(),
        alpha_max=ALPHA_MAX,
        frustum_clamp=True,
    )
    image.backward(scene.v_render.double())
    return image.detach(), [value.grad for value in inputs if value.grad is not None]
