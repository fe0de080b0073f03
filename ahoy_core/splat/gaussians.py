"""The one dataclass of Gaussians that formats, avatar and rasterizer share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor


@dataclass(frozen=True)
class Gaussians:
    """N anisotropic 3D Gaussians, all values post-activation (as rendered, not as stored in `.ply`).

    Attributes:
        means: [N,3] world, metres.
        quats: [N,4] wxyz, any length; zero is the identity.
        scales: [N,3] standard deviations, metres, >= 0.
        opacities: [N] in [0,1].
        colors: [N,3] sRGB in [0,1], or any number of channels [N,D].
        features: [N,F] further channels (such as coverage), or None.
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor
    features: Tensor | None = None

    def __post_init__(self) -> None:
        count = len(self.means)
        expected = {"means": (count, 3), "quats": (count, 4), "scales": (count, 3), "opacities": (count,)}
        for name, shape in expected.items():
            if tuple(getattr(self, name).shape) != shape:
                raise ValueError(f"{name}: expected shape {shape}, got {tuple(getattr(self, name).shape)}")
        for name, value in (("colors", self.colors), ("features", self.features)):
            if value is not None and (value.dim() != 2 or len(value) != count):
                raise ValueError(f"{name}: expected shape ({count}, D), got {tuple(value.shape)}")

    def __len__(self) -> int:
        return len(self.means)

    def to(self, *args: Any, **kwargs: Any) -> Gaussians:
        """The same Gaussians with every tensor converted as by `Tensor.to`."""
        tensors = (self.means, self.quats, self.scales, self.opacities, self.colors, self.features)
        return Gaussians(*(None if t is None else t.to(*args, **kwargs) for t in tensors))  # type: ignore[arg-type]

    def covariances(self) -> Tensor:
        """World covariances R S S R^T, [N,3,3], metres^2; differentiable in quats and scales."""
        half = quats_to_rotations(self.quats) * self.scales[:, None, :]
        return half @ half.transpose(1, 2)


def quats_to_rotations(quats: Tensor) -> Tensor:
    """Rotations [N,3,3] of quaternions [N,4] wxyz of any length; zero is the identity and gets no gradient."""
    safe = torch.where((quats != 0).any(-1, keepdim=True), quats, torch.tensor([1.0, 0, 0, 0]).to(quats))
    w, x, y, z = torch.nn.functional.normalize(safe, dim=-1, eps=0.0).unbind(-1)
    rows = (
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip
    return torch.stack(rows, -1).reshape(-1, 3, 3)
