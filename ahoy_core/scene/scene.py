"""A scene of Gaussians in our world: metres, z up, the ground at z = 0."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import torch
from torch import Tensor

from ahoy_core.formats.cameras import CameraFile
from ahoy_core.formats.glb import read_glb
from ahoy_core.formats.ply import read_ply
from ahoy_core.formats.spz import read_spz
from ahoy_core.scene.ground import Ground, find_ground
from ahoy_core.splat.constants import ALPHA_CUTOFF
from ahoy_core.splat.gaussians import Gaussians
from ahoy_core.splat.transform import Similarity, transform_gaussians

EYE_HEIGHT = 1.5
"""Metres: how high people hold a telephone, by which a scene filmed by hand is scaled when nothing else is known."""
BYTES_EACH = 700
"""Of memory for one Gaussian of a scene: attributes, harmonics, and the rasterizer's working copies."""


@dataclass(frozen=True)
class Scene:
    """A scene.

    Attributes:
        gaussians: N Gaussians in our world.
        sh_rest: [N,K,3] higher spherical harmonics, or None.
        ground: The plane that was found or given; None if there is none.
        to_world: From the file's coordinates to ours: cameras of the file go the same way.
        name: Of the scene.
        notes: What was found, assumed or left out, one sentence each.
    """

    gaussians: Gaussians
    sh_rest: Tensor | None
    ground: Ground | None
    to_world: Similarity
    name: str = "scene"
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.gaussians)

    @cached_property
    def covars(self) -> Tensor:
        """[N,3,3] metres²."""
        return self.gaussians.covariances()


def empty_scene() -> Scene:
    """Nothing at all: an avatar over a plain background."""
    nothing = Gaussians(*(torch.zeros(0, *shape) for shape in ((3,), (4,), (3,), (), (3,))))
    return Scene(nothing, None, None, Similarity.identity(), "empty")


def read_splats(path: str | Path) -> tuple[Gaussians, Tensor | None]:
    """Gaussians and their higher spherical harmonics from `.ply`, `.spz` or `.glb`, in the file's axes.

    Raises:
        ValueError: Another kind of file, or a damaged one.
    """
    source = Path(path)
    match source.suffix.lower():
        case ".ply":
            ply = read_ply(source)
            return ply.gaussians, ply.sh_rest
        case ".spz":
            spz = read_spz(source)
            return spz.gaussians, spz.sh_rest
        case ".glb":
            glb = read_glb(source)
            return glb.gaussians, glb.sh_rest
    raise ValueError(f"expected a scene as .ply, .spz or .glb, got {source.name!r}; convert it to one of these")


def make_scene(
    gaussians: Gaussians,
    sh_rest: Tensor | None = None,
    *,
    name: str = "scene",
    cameras: CameraFile | None = None,
    up: Tensor | None = None,
    metres_per_unit: float | None = None,
    memory_budget: int | None = None,
) -> Scene:
    """Put Gaussians into our world: find the ground, and the scale.

    Args:
        gaussians: In the file's axes and units.
        sh_rest: Higher spherical harmonics, or None.
        name: For notes.
        cameras: The cameras that the scene was made from: they know which way is up, and how high they were held.
        up: [3] direction that is up in the file, if known.
        metres_per_unit: The scale, if known; else from the height of the cameras, else 1.
        memory_budget: Bytes that the scene may take (None: no bound).

    Raises:
        MemoryError: The scene would take more than the budget.
    """
    seen = gaussians.opacities >= ALPHA_CUTOFF
    notes = []
    if not bool(seen.all()):
        notes.append(f"{int((~seen).sum())} Gaussians too faint to be drawn were left out")
        gaussians, sh_rest = _rows(gaussians, seen), None if sh_rest is None else sh_rest[seen]
    needed = len(gaussians) * BYTES_EACH
    if memory_budget is not None and needed > memory_budget:
        raise MemoryError(
            f"expected a scene within {memory_budget / 2**20:.0f} MB, got {len(gaussians)} Gaussians, which take about "
            f"{needed / 2**20:.0f} MB; crop or thin it, or raise the budget"
        )
    if up is None and cameras is not None and len(cameras.names):
        # OpenCV's y points down in the picture; people hold cameras level on average.
        up = -cameras.viewmats[:, 1, :3].mean(0)
    ground = find_ground(gaussians, up)
    to_world = Similarity.identity() if ground is None else ground.levelled()
    scale, why = _scale(metres_per_unit, cameras, to_world)
    to_world = to_world.then(replace(Similarity.identity(), scale=scale))
    notes += [why, "no ground was found: z = 0 is where the file has it" if ground is None else ground.describe()]
    moved, rest = transform_gaussians(gaussians, to_world, sh_rest)
    return Scene(moved, rest, ground, to_world, name, tuple(notes))


def _rows(gaussians: Gaussians, chosen: Tensor) -> Gaussians:
    parts = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.colors)
    return Gaussians(*(part[chosen] for part in parts))


def _scale(given: float | None, cameras: CameraFile | None, level: Similarity) -> tuple[float, str]:
    """Metres per unit, and where it came from."""
    if given is not None:
        return given, f"scale given: {given:g} metres a unit"
    if cameras is None:
        return 1.0, "scale assumed: 1 metre a unit"
    heights = torch.linalg.inv(level.viewmats(cameras.viewmats.double()))[:, 2, 3]
    middle = float(heights.median())
    if not middle > 0:
        return 1.0, "scale assumed: 1 metre a unit, as the cameras are not above the ground"
    return EYE_HEIGHT / middle, f"scale from the cameras, which were taken as held at {EYE_HEIGHT} m"
