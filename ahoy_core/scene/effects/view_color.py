"""View-dependent colour: the scene's higher spherical harmonics, by which reflections move with the camera."""

from __future__ import annotations

import torch
from torch import Tensor

from ahoy_core.conventions import Cameras
from ahoy_core.formats.ply import SH_C0
from ahoy_core.scene.cost import Rates
from ahoy_core.scene.effects.effect import Effect, Verdict
from ahoy_core.scene.scene import Scene
from ahoy_core.scene.shot import Content
from ahoy_core.splat.sh import sh_to_colors

_LEAST = 1 / 255
"""Mean change of the colours under which no picture changes: one step of 8 bits."""


def colors_towards(scene: Scene, rows: Tensor, cameras: Cameras) -> Tensor:
    """Colours [M,3] of some of a scene's Gaussians as the first camera sees them.

    Args:
        scene: With higher harmonics.
        rows: [M] which.
        cameras: The first one counts.

    Raises:
        ValueError: If the scene has no higher harmonics.
    """
    if scene.sh_rest is None:
        raise ValueError(
            "expected a scene with higher spherical harmonics, got none; its colours are the same everywhere"
        )
    constant = (scene.gaussians.colors[rows] - 0.5) / SH_C0
    coefficients = torch.cat([constant[:, None], scene.sh_rest[rows]], 1)
    degree = {4: 1, 9: 2, 16: 3}[coefficients.shape[1]]
    visible = torch.ones(1, len(rows), 2, dtype=torch.int32)
    return sh_to_colors(scene.gaussians.means[rows], cameras.viewmats[:1], coefficients, visible, degree)[0]


def _judge(content: Content) -> Verdict:
    scene = content.scene
    if scene.sh_rest is None:
        return Verdict(False, "the scene's colours do not depend on the view")
    rows = torch.arange(0, len(scene), max(1, len(scene) // 5000))
    towards = colors_towards(scene, rows, content.shot.at(0))
    change = float((towards - scene.gaussians.colors[rows].clamp(min=0)).abs().mean())
    evidence = {"mean_change": round(change, 5)}
    if change < _LEAST:
        return Verdict(False, "from here the scene's harmonics change no colour by a visible step", evidence)
    return Verdict(True, f"seen from here the scene's colours differ by {change:.1%} on average", evidence)


def _seconds(content: Content, verdict: Verdict, rates: Rates) -> float:
    views = 1 if content.shot.still else content.frames
    return views * len(content.scene) * rates.shade / 4


VIEW_COLOR = Effect(
    "view_color",
    "the scene's reflections follow the camera",
    _judge,
    _seconds,
    lambda content: content.scene.sh_rest is not None,
)
