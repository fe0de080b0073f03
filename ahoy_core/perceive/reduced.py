"""The body's landmarks as a function of a few joints: what the fit differentiates instead of thousands of vertices.

Skinning is linear in the rest vertices, and a landmark is a weighted sum of vertices. So landmark k of a posed body
is sum_f T_f m_kf with the moments m_kf = sum_v w_kv W_vf [x_v; 1], and a joint that never turns relative to its
parent shares its parent's T: fingers, toes and face fold into the joints that the fit moves. This is exact, not an
approximation, for a body with plain LBS.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ahoy_core.body.lbs import forward_kinematics
from ahoy_core.body.model import BodyModel

SHAPE_STEP = (
    0.02  # of a finite difference in betas: large enough for float32, small enough for a shape space with bends
)


@dataclass(frozen=True)
class ReducedBody:
    """Landmarks and moving joints of a body whose other joints rest.

    Attributes:
        free: indices of the moving joints in the full body, the root first, parents before children.
        parents: of the moving joints, among themselves.
        base_betas: [S] shape at which the linear model below is exact.
        moments: [33,F,4] at `base_betas`.
        joints: [F,3] rest positions at `base_betas`.
        moment_slopes: [S,33,F,4], per unit of each beta.
        joint_slopes: [S,F,3].
        surface: [V,3] rest vertices at `base_betas`.
        surface_slopes: [S,V,3].
        skin: [V,F] skinning weights, those of resting joints folded into the joint that carries them.
        stature: metres from the lowest to the highest point at `base_betas`.
        stature_slopes: [S].
        reach: [S] metres, root mean square over the surface, per unit of each beta; of the one that is mostly size,
            what it does besides making the whole body larger or smaller.
        size: which beta is mostly size, at the shape that the body was first reduced at. It stays that one: near some
            shapes age is more like size than stature is, and a woman would become a child of her height.
    """

    free: tuple[int, ...]
    parents: tuple[int, ...]
    base_betas: Tensor
    moments: Tensor
    joints: Tensor
    moment_slopes: Tensor
    joint_slopes: Tensor
    surface: Tensor
    surface_slopes: Tensor
    skin: Tensor
    stature: Tensor
    stature_slopes: Tensor
    reach: Tensor
    size: int

    def __call__(self, rotations: Tensor, transl: Tensor, betas: Tensor) -> tuple[Tensor, Tensor]:
        """Pose the landmarks.

        Args:
            rotations: [T,F,3,3] of the moving joints, relative to their moving parent; the root's in the world.
            transl: [T,3] metres.
            betas: [S].

        Returns:
            Landmarks [T,33,3] and moving joints [T,F,3], metres, world.
        """
        moments, rest = self.shaped_moments(betas), self.rest_joints(betas)
        transforms = forward_kinematics(rotations, rest[None], self.parents, transl)[:, :, :3]
        landmarks = torch.einsum("tfij,kfj->tki", transforms, moments)
        joints = (transforms[..., :3] @ rest[..., None])[..., 0] + transforms[..., 3]
        return landmarks, joints

    def rest_joints(self, betas: Tensor) -> Tensor:
        """Rest positions [F,3] of the moving joints for a shape [S]."""
        return self.joints + torch.einsum("s,sfc->fc", betas - self.base_betas, self.joint_slopes)

    def shaped_moments(self, betas: Tensor) -> Tensor:
        """Moments [33,F,4] for a shape [S]."""
        return self.moments + torch.einsum("s,skfc->kfc", betas - self.base_betas, self.moment_slopes)

    def shaped_surface(self, betas: Tensor) -> Tensor:
        """Rest vertices [V,3] for a shape [S]."""
        return self.surface + torch.einsum("s,svc->vc", betas - self.base_betas, self.surface_slopes)

    def shaped_stature(self, betas: Tensor) -> Tensor:
        """Stature [] in metres for a shape [S]."""
        return self.stature + self.stature_slopes @ (betas - self.base_betas)

    def expand(self, axis_angle: Tensor, n_joints: int) -> Tensor:
        """Spread [T,F,3] over all joints of the body, [T,J,3]; the others rest."""
        pose = axis_angle.new_zeros(len(axis_angle), n_joints, 3)
        pose[:, list(self.free)] = axis_angle
        return pose


def reduce_body(body: BodyModel, free: Sequence[int], betas: Tensor) -> ReducedBody:
    """Fold a body into its moving joints, with a linear model of shape round `betas`.

    Args:
        body: a `BodyModel`.
        free: indices of the moving joints, the root (0) among them.
        betas: [S] where the shape model is exact; call again (`reshape`) when the shape has moved far.

    Raises:
        ValueError: the root is not among the moving joints.
    """
    chosen = tuple(sorted(set(free)))
    if not chosen or chosen[0] != 0:
        raise ValueError(f"expected the root, joint 0, among the moving joints, got {chosen}")
    row = {joint: i for i, joint in enumerate(chosen)}
    carrier = _carriers(body.parents, row)
    parents = tuple(-1 if j == 0 else carrier[body.parents[j]] for j in chosen)
    carriers = torch.tensor([carrier[joint] for joint in range(len(body.parents))])
    skin = betas.new_zeros(len(body.lbs_weights), len(chosen)).index_add_(1, carriers, body.lbs_weights.to(betas))
    return _shaped(chosen, parents, skin, body, betas, None)


def reshape(reduced: ReducedBody, body: BodyModel, betas: Tensor) -> ReducedBody:
    """Rebuild the linear shape model round other betas [S]."""
    return _shaped(reduced.free, reduced.parents, reduced.skin, body, betas, reduced.size)


def _shaped(
    free: tuple[int, ...], parents: tuple[int, ...], skin: Tensor, body: BodyModel, betas: Tensor, size: int | None
) -> ReducedBody:
    """The linear shape model round betas [S]; without `size` that is chosen here."""
    n = len(betas)
    step = SHAPE_STEP * torch.eye(n).to(betas)
    steps = torch.cat([torch.zeros_like(betas)[None], step, -step])
    support, place = body.landmark_indices.unique(return_inverse=True)
    weights = betas.new_zeros(len(place), len(support)).scatter_add_(1, place, body.landmark_weights.to(betas))
    like = body.default_betas
    moments, joints, surfaces = [], [], []
    with torch.no_grad():
        for shape in (betas + steps).to(like):
            out = body(like.new_zeros(1, body.n_joints, 3), shape[None], like.new_zeros(1, 3))
            moments.append(_moments(weights, skin[support], out.rest_vertices[0, support].to(betas)))
            surfaces.append(out.rest_vertices[0].to(betas))
            joints.append(out.rest_joints[0, list(free)].to(betas))
    m, j, surface = torch.stack(moments), torch.stack(joints), torch.stack(surfaces)
    slopes = (surface[1 : n + 1] - surface[n + 1 :]) / (2 * SHAPE_STEP)
    whole, rest = _reaches(surface[0], slopes)
    size = int((rest / whole.clamp_min(1e-9)).argmin()) if size is None else size
    height = surface[..., 2].amax(1) - surface[..., 2].amin(1)
    return ReducedBody(
        free=free,
        parents=parents,
        base_betas=betas.detach().clone(),
        moments=m[0],
        joints=j[0],
        moment_slopes=(m[1 : n + 1] - m[n + 1 :]) / (2 * SHAPE_STEP),
        joint_slopes=(j[1 : n + 1] - j[n + 1 :]) / (2 * SHAPE_STEP),
        surface=surface[0],
        surface_slopes=slopes,
        skin=skin,
        stature=height[0],
        stature_slopes=(height[1 : n + 1] - height[n + 1 :]) / (2 * SHAPE_STEP),
        reach=torch.where(torch.arange(n) == size, rest, whole),
        size=size,
    )


def _reaches(surface: Tensor, slopes: Tensor) -> tuple[Tensor, Tensor]:
    """Root mean squares [S] of slopes [S,V,3], as they are and without the surface's [V,3] uniform growth."""
    centred, moved = surface - surface.mean(0), slopes - slopes.mean(1, keepdim=True)
    growth = (moved * centred).sum((1, 2)) / centred.square().sum()
    rest = (moved - growth[:, None, None] * centred).square().sum(-1).mean(-1).sqrt()
    return slopes.square().sum(-1).mean(-1).sqrt(), rest


def _carriers(parents: Sequence[int], row: dict[int, int]) -> list[int]:
    """For every joint, the row of the nearest moving joint at or above it."""
    carriers: list[int] = []
    for joint, parent in enumerate(parents):
        carriers.append(row[joint] if joint in row else carriers[parent])
    return carriers


def _moments(weights: Tensor, skin: Tensor, points: Tensor) -> Tensor:
    """sum_v w_kv W_vf [x_v; 1]: weights [K,V], skin [V,F], points [V,3] -> [K,F,4]."""
    homogeneous = torch.cat([points, torch.ones_like(points[:, :1])], dim=1)
    return torch.einsum("kv,vf,vc->kfc", weights, skin, homogeneous)
