"""Pose-dependent position maps: what the full avatar's StyleUNet is told about a pose (paper section 3.3).

A map pixel holds where its Gaussian's surface point is in the pose, with the root's rotation and translation removed:
turning or moving the whole person changes nothing, bit for bit, because neither enters the computation.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from ahoy_core.avatar.deform import dense_weights
from ahoy_core.avatar.kinematics import Kinematics
from ahoy_core.maps.template import Template


@dataclass(frozen=True)
class PoseMaps:
    """Maker of the maps of one person.

    Attributes:
        template: N Gaussians in the canonical pose.
        kinematics: The person's skeleton.
        reduction: The maps' side is the template's over this; 1 gives each Gaussian a pixel of its own, 2 lets a block
            of 2x2 share one.
    """

    template: Template
    kinematics: Kinematics
    reduction: int = 1

    @property
    def size(self) -> int:
        """Side of the maps."""
        return self.template.map_size // self.reduction

    @cached_property
    def lbs_weights(self) -> Tensor:
        """[N,J] the surface's own skinning weights."""
        return dense_weights(self.template.skin_indices, self.template.skin_weights, self.kinematics.n_joints)

    @torch.no_grad()
    def positions(self, rotations: Tensor) -> Tensor:
        """Surface points in a pose, relative to the root.

        Args:
            rotations: [J,3,3] local rotations; the root's is ignored.

        Returns:
            [N,3] metres; the template's means for the canonical pose.
        """
        skeleton, template = self.kinematics, self.template
        upright = torch.cat([skeleton.canonical[:1].to(rotations), rotations[1:]])
        relative = skeleton.relative(upright[None], rotations.new_zeros(1, 3))[0]
        blend = (self.lbs_weights @ relative[:, :3].flatten(1)).unflatten(1, (3, 4))
        return (blend[:, :, :3] @ template.means[:, :, None])[:, :, 0] + blend[:, :, 3]

    def __call__(self, rotations: Tensor) -> Tensor:
        """Maps of poses: [G,14,size,size] for local rotations [G,J,3,3]."""
        return torch.cat([self.reduce(self.template.maps(self.positions(pose))) for pose in rotations])

    def reduce(self, maps: Tensor) -> Tensor:
        """Mean of each block's occupied pixels: [B,C,S,S] -> [B,C,size,size]; 0 where a block has none."""
        if self.reduction == 1:
            return maps
        return avg_pool2d(maps, self.reduction) / self._taken.repeat_interleave(maps.shape[1] // 2, 1)

    @cached_property
    def _taken(self) -> Tensor:
        """[1,2,size,size] share of each block that Gaussians occupy."""
        side, row, column = self.template.pixels.unbind(1)
        taken = self.template.means.new_zeros(1, 2, self.template.map_size, self.template.map_size)
        taken[0, side, row, column] = 1
        return avg_pool2d(taken, self.reduction).clamp(min=1e-6)

    def gather(self, maps: Tensor) -> Tensor:
        """Read maps [2,C,size,size] at the Gaussians' pixels: [N,C].

        Not by indexing with tensors: Gaussians share reduced pixels, and that one's gradient adds theirs up in
        whatever order the threads come.
        """
        side, row, column = self.template.pixels.unbind(1)
        flat = (side * self.size + row // self.reduction) * self.size + column // self.reduction
        return maps.movedim(1, -1).flatten(0, 2).index_select(0, flat)
