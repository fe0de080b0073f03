"""Random Gaussians for tests of file formats."""

from __future__ import annotations

import torch
from torch import Tensor

from ahoy_core.splat import Gaussians


def cloud(count: int = 200, seed: int = 0) -> Gaussians:
    g = torch.Generator().manual_seed(seed)
    return Gaussians(
        means=torch.randn(count, 3, generator=g),
        quats=torch.nn.functional.normalize(torch.randn(count, 4, generator=g), dim=1),
        scales=torch.exp(torch.randn(count, 3, generator=g) - 3),
        opacities=torch.rand(count, generator=g),
        colors=torch.rand(count, 3, generator=g),
    )


def harmonics(count: int = 200, terms: int = 15, seed: int = 1) -> Tensor:
    return 0.3 * torch.randn(count, terms, 3, generator=torch.Generator().manual_seed(seed))
