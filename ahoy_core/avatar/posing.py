"""What makes an avatar depend on its pose at inference: S(theta) with the map pose kept near training (section 3.4)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from ahoy_core.avatar.deform import Canonical, OffsetBounds, apply_offsets
from ahoy_core.avatar.pose_maps import PoseMaps
from ahoy_core.avatar.pose_prior import PosePrior
from ahoy_core.maps.style_unet import StyleUNet


@dataclass(frozen=True)
class PoseDependence:
    """The pose-dependent part of a full avatar.

    Attributes:
        base: [N,C] raw offsets that all poses share.
        map_rotations: [G,J,3,3] map poses of training.
        reduction: Side of the template's maps over that of the pose maps.
        components: Axes of the map poses that driving poses keep to.
        strength: How far a driving pose's map is pulled to them, [0,1].
    """

    base: Tensor
    map_rotations: Tensor
    reduction: int
    components: int
    strength: float

    @cached_property
    def prior(self) -> PosePrior:
        """The training distribution of map poses."""
        return PosePrior.of(self.map_rotations, self.components)

    @torch.no_grad()
    def gaussians(
        self, maps: PoseMaps, network: StyleUNet, bounds: OffsetBounds, rotations: Tensor, strength: float | None = None
    ) -> Canonical:
        """Canonical Gaussians for a driving pose, colours within [0,1].

        Args:
            maps: Maker of the pose maps, with this `reduction`.
            network: The trained StyleUNet.
            bounds: Largest offsets.
            rotations: [J,3,3] local rotations; the root's does not matter.
            strength: In place of the stored one.
        """
        inside = self.prior.project(rotations, self.strength if strength is None else strength)
        raw = self.base + maps.gather(network(maps(inside[None]))[0])
        canonical = apply_offsets(maps.template, raw, bounds)
        return replace(canonical, colors=canonical.colors.clamp(0, 1))
