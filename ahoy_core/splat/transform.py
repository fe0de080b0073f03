"""Gaussians moved, turned and scaled as a whole, their view-dependent colours with them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import torch
from torch import Tensor

from ahoy_core.body.rotations import matrix_to_quaternion
from ahoy_core.splat.gaussians import Gaussians
from ahoy_core.splat.sh import C0, C1, C2, C3


@dataclass(frozen=True)
class Similarity:
    """x -> scale * rotation @ x + shift.

    Attributes:
        rotation: [3,3], float64.
        shift: [3], in the units of the result.
        scale: Above 0.
    """

    rotation: Tensor
    shift: Tensor
    scale: float = 1.0

    def __post_init__(self) -> None:
        turned = self.rotation @ self.rotation.T
        if not torch.allclose(turned, torch.eye(3).to(turned), atol=1e-5) or float(torch.det(self.rotation)) < 0:
            raise ValueError("expected a rotation without reflection, scale or shear; put the scale into `scale`")
        if not 0 < self.scale < float("inf"):
            raise ValueError(f"expected a positive scale, got {self.scale}")

    @classmethod
    def identity(cls) -> Similarity:
        """Leaves everything where it is."""
        return cls(torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))

    def points(self, points: Tensor) -> Tensor:
        """[...,3] moved, computed in float64."""
        moved = self.scale * points.double() @ self.rotation.T.double() + self.shift.double()
        return moved.to(points.dtype)

    def inverse(self) -> Similarity:
        """What undoes it."""
        back = self.rotation.T
        return Similarity(back, -(back @ self.shift) / self.scale, 1 / self.scale)

    def then(self, after: Similarity) -> Similarity:
        """This one first, then `after`."""
        shift = after.scale * (after.rotation @ self.shift) + after.shift
        return Similarity(after.rotation @ self.rotation, shift, after.scale * self.scale)

    def viewmats(self, viewmats: Tensor) -> Tensor:
        """World-to-camera matrices [C,4,4] of cameras that moved along; distances grow by the scale."""
        rotation = viewmats[:, :3, :3].double() @ self.rotation.T
        shift = self.scale * viewmats[:, :3, 3].double() - rotation @ self.shift
        moved = viewmats.double().clone()
        moved[:, :3, :3], moved[:, :3, 3] = rotation, shift
        return moved.to(viewmats.dtype)


def transform_gaussians(
    gaussians: Gaussians, similarity: Similarity, sh_rest: Tensor | None = None
) -> tuple[Gaussians, Tensor | None]:
    """Gaussians moved by a similarity, and their higher spherical harmonics turned with them.

    Args:
        gaussians: N Gaussians.
        similarity: Where they go.
        sh_rest: [N,K,3] higher spherical harmonics, K = 3, 8 or 15, or None.
    """
    turn = matrix_to_quaternion(similarity.rotation.double())
    moved = replace(
        gaussians,
        means=similarity.points(gaussians.means),
        quats=_product(turn.to(gaussians.quats), gaussians.quats),
        scales=gaussians.scales * similarity.scale,
    )
    return moved, None if sh_rest is None else rotate_sh(sh_rest, similarity.rotation)


def _product(q: Tensor, r: Tensor) -> Tensor:
    """Hamilton product of quaternions wxyz, [4] times [N,4]."""
    w, v = q[0], q[1:]
    vector = w * r[:, 1:] + r[:, :1] * v + torch.linalg.cross(v.expand_as(r[:, 1:]), r[:, 1:])
    return torch.cat([w * r[:, :1] - (r[:, 1:] @ v)[:, None], vector], 1)


def rotate_sh(sh_rest: Tensor, rotation: Tensor) -> Tensor:
    """Higher spherical harmonics of a thing that was turned.

    Each band is mixed among itself by a matrix that is solved for at fixed directions, which is exact because a band
    is closed under rotation (Ramamoorthi and Hanrahan 2001).

    Args:
        sh_rest: [N,K,3], K = 3, 8 or 15: bands 1, 2 and 3.
        rotation: [3,3].
    """
    directions = _directions()
    before, after = sh_basis(directions @ rotation.double()), sh_basis(directions)
    turned = []
    start = 1
    for size in (3, 5, 7):
        if start - 1 >= sh_rest.shape[1]:
            break
        band = slice(start, start + size)
        mix = torch.linalg.lstsq(after[:, band], before[:, band]).solution
        turned.append(torch.einsum("ij,njc->nic", mix.to(sh_rest), sh_rest[:, start - 1 : start - 1 + size]))
        start += size
    return torch.cat(turned, 1)


@lru_cache(maxsize=1)
def _directions() -> Tensor:
    """[64,3] unit directions, evenly spread (a Fibonacci sphere): many more than a band's seven unknowns."""
    i = torch.arange(64, dtype=torch.float64) + 0.5
    z = 1 - 2 * i / 64
    angle = torch.pi * (1 + 5**0.5) * i
    ring = (1 - z * z).sqrt()
    return torch.stack([ring * torch.cos(angle), ring * torch.sin(angle), z], 1)


def sh_basis(directions: Tensor) -> Tensor:
    """The sixteen real spherical harmonics [M,16] at unit directions [M,3], in the order and signs of 3DGS files."""
    x, y, z = directions.unbind(1)
    xx, yy, zz = x * x, y * y, z * z
    one = torch.ones_like(x)
    rows = (
        C0 * one, -C1 * y, C1 * z, -C1 * x,
        C2[0] * x * y, -C2[0] * y * z, C2[1] * (3 * zz - 1), -C2[0] * x * z, C2[2] * (xx - yy),
        -C3[0] * y * (3 * xx - yy), C3[1] * x * y * z, -C3[2] * y * (5 * zz - 1), C3[3] * z * (5 * zz - 3),
        -C3[2] * x * (5 * zz - 1), C3[4] * z * (xx - yy), -C3[0] * x * (xx - 3 * yy),
    )  # fmt: skip
    return torch.stack(rows, 1)
