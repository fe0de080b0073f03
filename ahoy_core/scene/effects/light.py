"""Light and exposure match: an avatar takes the colour and direction of the light where it stands.

The scene is rendered from the avatar's chest in six directions; its linear colours become irradiance by direction as
nine spherical harmonics (Ramamoorthi and Hanrahan, An Efficient Representation for Irradiance Environment Maps, 2001).
An avatar's colours were filmed under light that its video does not tell; they are taken as filmed under an even grey of
sRGB 0.5, which is what automatic exposure aims at. Directions in which the scene has nothing get its mean colour.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ahoy_core.conventions import Cameras
from ahoy_core.scene.color import to_linear, to_srgb
from ahoy_core.scene.cost import Rates, rasterize
from ahoy_core.scene.effects.effect import Effect, Verdict
from ahoy_core.scene.scene import Scene
from ahoy_core.scene.shot import Content
from ahoy_core.splat.transform import sh_basis

SIZE = 16
"""Pixels a side of each of the six pictures."""
REFERENCE = float(to_linear(torch.tensor(0.5)))
"""Linear grey that an avatar is taken to have been filmed under."""
_LEAST_COVER = 0.25
_LEAST_GAIN = 0.05
_GAIN_BOUNDS = (0.25, 4.0)
# Cosine lobe in spherical harmonics, bands 0, 1 and 2, over pi: irradiance of an even environment is its own colour.
_LOBE = (1.0, 2 / 3, 1 / 4)
_FACES = (
    ((1, 0, 0), (0, 0, 1)), ((-1, 0, 0), (0, 0, 1)), ((0, 1, 0), (0, 0, 1)),
    ((0, -1, 0), (0, 0, 1)), ((0, 0, 1), (0, 1, 0)), ((0, 0, -1), (0, 1, 0)),
)  # fmt: skip


def cube_cameras(center: Tensor, size: int) -> Cameras:
    """Six cameras of 90 degrees that see everything round a point [3]."""
    views = []
    for forward, up in _FACES:
        z, y = torch.tensor(forward, dtype=torch.float32), -torch.tensor(up, dtype=torch.float32)
        rotation = torch.stack([torch.linalg.cross(y, z), y, z])
        view = torch.eye(4)
        view[:3, :3], view[:3, 3] = rotation, -(rotation @ center)
        views.append(view)
    K = torch.tensor([[size / 2, 0, size / 2], [0, size / 2, size / 2], [0, 0, 1]])
    return Cameras(torch.stack(views), K.expand(6, 3, 3).clone(), size, size)


def cube_directions(size: int) -> tuple[Tensor, Tensor]:
    """World directions [6,size,size,3] of the cube's pixels, and their solid angles [size,size]."""
    x = (torch.arange(size) + 0.5) / size * 2 - 1
    v, u = torch.meshgrid(x, x, indexing="ij")
    rays = torch.stack([u, v, torch.ones_like(u)], -1)
    rotations = cube_cameras(torch.zeros(3), size).viewmats[:, :3, :3]
    directions = torch.nn.functional.normalize(torch.einsum("cij,hwi->chwj", rotations, rays), dim=-1)
    return directions, (2 / size) ** 2 / (1 + u * u + v * v) ** 1.5


def surroundings(scene: Scene, center: Tensor, size: int = SIZE) -> tuple[Tensor, float]:
    """What is seen from a point: linear colours [6,size,size,3], and the share of directions that the scene covers."""
    gaussians = scene.gaussians
    image, alpha, _ = rasterize(
        gaussians.means, scene.covars, gaussians.opacities, gaussians.colors, cube_cameras(center, size)
    )
    _, angles = cube_directions(size)
    weights = angles[None, :, :, None] * alpha
    linear = to_linear(image / alpha.clamp(min=1e-6))
    cover = float(weights.sum() / (6 * angles.sum()))
    mean = (linear * weights).sum((0, 1, 2)) / weights.sum().clamp(min=1e-9)
    return linear * alpha + mean * (1 - alpha), cover


def irradiance(linear: Tensor) -> Tensor:
    """Irradiance over pi as harmonics [9,3] of surroundings [6,size,size,3]; of an even one it is the colour itself."""
    directions, angles = cube_directions(linear.shape[1])
    basis = sh_basis(directions.reshape(-1, 3))[:, :9]
    weights = angles.expand(6, -1, -1).reshape(-1, 1)
    coefficients = (basis * weights).T @ linear.reshape(-1, 3)
    lobe = torch.tensor([_LOBE[0]] + [_LOBE[1]] * 3 + [_LOBE[2]] * 5)
    return coefficients * lobe[:, None]


def gains(light: Tensor, normals: Tensor, strength: float = 1.0) -> Tensor:
    """Factors [N,3] on linear colours of surfaces with normals [N,3] in a light [9,3]."""
    received = sh_basis(normals)[:, :9] @ light
    return (received / REFERENCE).clamp(*_GAIN_BOUNDS) ** strength


def relight(colors: Tensor, normals: Tensor, light: Tensor, strength: float = 1.0) -> Tensor:
    """Colours [N,3] sRGB of an avatar under a light [9,3], its normals [N,3] in the world."""
    return to_srgb(to_linear(colors) * gains(light, normals, strength))


def chest(content: Content, puppet: int) -> Tensor:
    """[3] the middle of an avatar at a middle moment: where its light is taken."""
    places = content.surfaces[puppet][len(content.moments) // 2][0]
    return (places.amin(0) + places.amax(0)) / 2


def _judge(content: Content) -> Verdict:
    if not len(content.scene) or not content.puppets:
        return Verdict(False, "there is no scene to give light" if content.puppets else "there is no avatar")
    linear, cover = surroundings(content.scene, chest(content, 0))
    light = irradiance(linear)
    directions = torch.nn.functional.normalize(torch.tensor([list(f) for f, _ in _FACES], dtype=torch.float32), dim=1)
    factor = gains(light, directions)
    change = float((torch.log(factor)).abs().mean())
    evidence = {"covered": round(cover, 3), "mean_change": round(math.expm1(change), 3)}
    if cover < _LEAST_COVER:
        return Verdict(False, f"the scene surrounds the avatar in only {cover:.0%} of directions", evidence)
    if change < _LEAST_GAIN:
        return Verdict(False, "the scene's light is as even and grey as the avatar's own is taken to be", evidence)
    return Verdict(
        True, f"the light here differs from an even grey by {math.expm1(change):.0%} on average", evidence, SIZE
    )


def _seconds(content: Content, verdict: Verdict, rates: Rates) -> float:
    probe = 6 * len(content.scene) * (rates.gaussian + rates.visible / 3 + rates.intersection / 3)
    frame = content.avatar_gaussians * (rates.shade + rates.carry) + len(content.puppets) * rates.joints
    return len(content.puppets) * (probe + rates.joints) + content.frames * frame


LIGHT = Effect(
    "light",
    "avatars take the scene's light and exposure",
    _judge,
    _seconds,
    lambda content: bool(content.puppets) and len(content.scene) > 0,
)
