"""The ground under a scene: the plane that carries much of it, with hardly anything beneath."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ahoy_core.splat.gaussians import Gaussians, quats_to_rotations
from ahoy_core.splat.transform import Similarity

_CANDIDATES = 384
_SAMPLE = 20_000
# Of the scene's size: how far from the plane a Gaussian may be and still belong to it.
_TOLERANCE = 0.01
# Radians: how far a Gaussian's own normal may lean.
_LEAN = math.radians(20)
# Share of a scene's weight that may lie beneath its ground (reconstructions have floaters), and that must lie on it.
_MOST_BENEATH, _LEAST_ON = 0.1, 0.03


@dataclass(frozen=True)
class Ground:
    """A plane of the file: `normal` [3] points up, `normal @ x = offset`; `share` of the scene is on it."""

    normal: Tensor
    offset: float
    share: float

    def levelled(self) -> Similarity:
        """The least turn that makes the normal z, and the shift that puts the plane at z = 0."""
        z = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
        rotation = _least_turn(self.normal.double(), z)
        return Similarity(rotation, -self.offset * z)

    def describe(self) -> str:
        """One sentence."""
        lean = math.degrees(math.acos(min(1.0, abs(float(self.normal.abs().max())))))
        return (
            f"ground found: {self.share:.0%} of the scene lies on it, {lean:.1f} degrees from the file's nearest axis"
        )


def find_ground(gaussians: Gaussians, up: Tensor | None = None, seed: int = 0) -> Ground | None:
    """The plane with most of the scene's weight on it and nearly all of the rest above (RANSAC over Gaussians).

    A Gaussian alone proposes a plane, since the short axis of a flat one is its normal, so few trials do.

    Args:
        gaussians: The scene, any units.
        up: [3] direction that is roughly up, if known: planes leaning more than 30 degrees from it are no ground.
        seed: Of the trials.

    Returns:
        The plane, or None if nothing qualifies.
    """
    generator = torch.Generator().manual_seed(seed)
    if len(gaussians) < 10:
        return None
    chosen = torch.randperm(len(gaussians), generator=generator)[:_SAMPLE]
    means, scales = gaussians.means[chosen].double(), gaussians.scales[chosen].double()
    axes = quats_to_rotations(gaussians.quats[chosen].double())
    normals = axes.gather(2, scales.argmin(1)[:, None, None].expand(-1, 3, 1))[:, :, 0]
    # Area times opacity: what a Gaussian covers of the surface.
    two = scales.sort(1).values[:, 1:]
    weights = gaussians.opacities[chosen].double() * two.prod(1).clamp(max=float(two.prod(1).quantile(0.95)))
    weights = weights / weights.sum().clamp(min=1e-300)
    low, high = means.quantile(0.05, 0), means.quantile(0.95, 0)
    size = float((high - low).norm())
    best: Ground | None = None
    trials = torch.multinomial(weights + 1e-12, min(_CANDIDATES, len(weights)), generator=generator)
    for trial in trials.tolist():
        plane = _judged(means, normals, weights, normals[trial], means[trial], up, size)
        if plane is not None and (best is None or plane.share > best.share):
            best = plane
    return best


def _judged(
    means: Tensor, normals: Tensor, weights: Tensor, normal: Tensor, point: Tensor, up: Tensor | None, size: float
) -> Ground | None:
    """The plane of a trial, refined and directed upwards, or None if it is no ground."""
    for _ in range(2):
        heights = (means - point) @ normal
        inside = (heights.abs() < _TOLERANCE * size) & ((normals @ normal).abs() > math.cos(_LEAN))
        if float(weights[inside].sum()) < _LEAST_ON:
            return None
        share = weights[inside] / weights[inside].sum()
        point = share @ means[inside]
        spread = means[inside] - point
        _, _, rows = torch.linalg.svd((share[:, None] * spread).T @ spread)
        normal = rows[2]
    heights = (means - point) @ normal
    above = float(weights[heights > 2 * _TOLERANCE * size].sum())
    beneath = float(weights[heights < -2 * _TOLERANCE * size].sum())
    if up is not None:
        cosine = float(normal @ up.double() / up.double().norm())
        if abs(cosine) < math.cos(math.radians(30)):
            return None
        flip = cosine < 0
    else:
        flip = beneath > above
    if flip:
        normal, above, beneath = -normal, beneath, above
    if beneath > _MOST_BENEATH or above < beneath:
        return None
    inside = ((means - point) @ normal).abs() < _TOLERANCE * size
    return Ground(normal, float(normal @ point), float(weights[inside].sum()))


def _least_turn(a: Tensor, b: Tensor) -> Tensor:
    """The least rotation [3,3] that takes unit direction a to unit direction b; a half turn about x if opposite."""
    v, cosine = torch.linalg.cross(a, b), torch.dot(a, b)
    if float(cosine) < -1 + 1e-12:
        return torch.diag(torch.tensor([1.0, -1.0, -1.0]).to(a))
    x, y, z = v.tolist()
    K = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=a.dtype)
    return torch.eye(3).to(a) + K + K @ K / (1 + cosine)
