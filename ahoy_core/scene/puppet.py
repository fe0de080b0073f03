"""An avatar in a scene: who moves how, and quick access to where parts of it are.

`Avatar.pose` makes the Gaussians of a frame. Planning needs less, for many frames at once: the joints' transforms
alone, and a few surface points carried by them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from ahoy_core.avatar.avatar import Avatar
from ahoy_core.avatar.kinematics import Kinematics
from ahoy_core.body.lbs import blend_transforms
from ahoy_core.body.model import BodyModel
from ahoy_core.body.rotations import axis_angle_to_matrix
from ahoy_core.motion.motion import Motion

# Surface points that stand for an avatar where all of them would cost more than they tell.
SAMPLE = 1500


@dataclass(frozen=True)
class Points:
    """M surface points of an avatar in the canonical pose: means, outward normals, areas [M] m², skinning [M,J]."""

    means: Tensor
    normals: Tensor
    areas: Tensor
    lbs_weights: Tensor

    def __getitem__(self, rows: Tensor) -> Points:
        return Points(self.means[rows], self.normals[rows], self.areas[rows], self.lbs_weights[rows])

    def __len__(self) -> int:
        return len(self.means)

    def posed(self, relative: Tensor) -> tuple[Tensor, Tensor]:
        """Positions and unit normals [M,3] under the joints' transforms [J,4,4]."""
        blend = blend_transforms(self.lbs_weights, relative[None])[0]
        places = (blend[:, :3, :3] @ self.means[:, :, None])[:, :, 0] + blend[:, :3, 3]
        normals = (blend[:, :3, :3] @ self.normals[:, :, None])[:, :, 0]
        return places, torch.nn.functional.normalize(normals, dim=1)


@dataclass(frozen=True)
class Puppet:
    """One avatar, its body and its motion, placed in the world.

    Attributes:
        avatar: Who.
        body: The body model that poses it.
        motion: T frames, in the world.
    """

    avatar: Avatar
    body: BodyModel
    motion: Motion

    @cached_property
    def kinematics(self) -> Kinematics:
        """The skeleton, of this avatar's shape."""
        return Kinematics.of(self.body, self.avatar.betas)

    @property
    def rest(self) -> Tensor:
        """[J,3] joints at rest."""
        return self.kinematics.rest_joints[0]

    def relative(self, pose: Tensor, transl: Tensor) -> Tensor:
        """[T,J,4,4]: what takes the canonical body to each of T poses [T,J,3] with translations [T,3]."""
        return self.kinematics.relative(axis_angle_to_matrix(pose), transl)

    @cached_property
    def points(self) -> Points:
        """All Gaussians as surface points."""
        template = self.avatar.template
        return Points(self.avatar.means, template.rotations[:, :, 2], template.areas, self.avatar.lbs_weights)

    @cached_property
    def sample(self) -> Points:
        """An even choice of at most `SAMPLE` of them, which stand for the areas of all."""
        step = max(1, -(-len(self.points) // SAMPLE))
        chosen = self.points[torch.arange(0, len(self.points), step)]
        share = float(self.points.areas.sum() / chosen.areas.sum().clamp(min=1e-12))
        return Points(chosen.means, chosen.normals, chosen.areas * share, chosen.lbs_weights)

    @cached_property
    def _nearest(self) -> tuple[Tensor, Tensor]:
        """For each Gaussian: the three nearest of the sample [N,3], and their weights by inverse distance [N,3]."""
        return nearest_three(self.points.means, self.sample.means, 1e-4)

    def spread(self, values: Tensor) -> Tensor:
        """Values of the sample [M,...] brought to all Gaussians [N,...]."""
        rows, weights = self._nearest
        return torch.einsum("nk,nk...->n...", weights, values[rows])

    def surface(self, frames: list[int]) -> list[tuple[Tensor, Tensor]]:
        """Positions and normals of the sample at each of these frames."""
        relative = self.relative(self.motion.pose[frames], self.motion.transl[frames])
        return [self.sample.posed(one) for one in relative]


def nearest_three(places: Tensor, among: Tensor, soft: float) -> tuple[Tensor, Tensor]:
    """The three nearest of M points to each place (all, of fewer), and weights by inverse distance.

    Args:
        places: [N,3] metres.
        among: [M,3], M >= 1.
        soft: metres added to every distance, so that a point in the same place is not all.

    Returns:
        Rows of `among` [N,min(3,M)] and weights that sum to 1.
    """
    count = min(3, len(among))
    found = cKDTree(among.numpy()).query(places.numpy(), count)
    distance, rows = (torch.from_numpy(np.asarray(x).reshape(len(places), count)) for x in found)
    weights = 1 / (distance.float() + soft)
    return rows, weights / weights.sum(1, keepdim=True)
