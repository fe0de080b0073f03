"""The avatar: canonical Gaussians with skinning weights, ready to be posed, saved, loaded and trained further."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import cast

import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor

from ahoy_core.avatar.counting import multiplications
from ahoy_core.avatar.deform import Canonical, OffsetBounds, apply_offsets, deform, dense_weights
from ahoy_core.avatar.head import expression_basis
from ahoy_core.avatar.kinematics import Kinematics
from ahoy_core.avatar.pose_maps import PoseMaps
from ahoy_core.avatar.posing import PoseDependence
from ahoy_core.body.model import BodyModel
from ahoy_core.body.rotations import axis_angle_to_matrix, matrix_to_quaternion, quaternion_to_matrix
from ahoy_core.maps.style_unet import StyleUNet, StyleUNetConfig
from ahoy_core.maps.template import Template
from ahoy_core.splat import Gaussians

SYNTHETIC_LABEL = "Synthetic media: a computer-generated avatar of a person, made from video; parts of it are invented."


class AvatarInfo(BaseModel):
    """What an avatar file says about itself."""

    model_config = ConfigDict(frozen=True)

    body: str = Field(description="name of the body model whose poses drive the avatar")
    body_sha256: str = Field(default="", description="hash of the body's asset, empty if unknown")
    licence: str = Field(default="", description="licence of the avatar, from that of the footage")
    provenance: dict[str, str] = Field(default_factory=dict, description="source id, roles that made it, versions")
    synthetic_media: str = Field(default=SYNTHETIC_LABEL, min_length=1)


@dataclass(frozen=True)
class Posed:
    """N Gaussians in the world: means [N,3], covars [N,3,3], colors [N,3], opacities [N]: what the rasterizer takes."""

    means: Tensor
    covars: Tensor
    colors: Tensor
    opacities: Tensor


@dataclass(frozen=True)
class Mapped:
    """Gaussians for one map pose, with the covariances [N,3,3] and dense skinning weights [N,J] that follow."""

    rotations: Tensor
    strength: float | None
    canonical: Canonical
    covars: Tensor
    lbs_weights: Tensor

    def serves(self, rotations: Tensor, strength: float | None) -> bool:
        """Whether another pose has the same map: the root does not count."""
        return self.strength == strength and torch.equal(self.rotations[1:], rotations[1:])


@dataclass(frozen=True)
class Avatar:
    """A person as Gaussians on a body model.

    Attributes:
        means: [N,3] canonical pose, metres.
        quats: [N,4] wxyz.
        scales: [N,3] metres.
        opacities: [N] in [0,1].
        colors: [N,3] sRGB in [0,1].
        skin_weights: [N,K] of the joints in `skin_indices`, rows sum to 1.
        betas: [S] the body's shape.
        training_poses: [T,J,3] axis-angle poses it was trained on (what animation may stay near to).
        template: Where the Gaussians started: holds uv, observed, head, skin_indices.
        network: The StyleUNet that made the offsets; training goes on from it.
        bounds: The largest offsets that it can make.
        info: Body, licence, provenance, label.
        posing: What makes a full avatar depend on its pose; None for a coarse one. The Gaussians above are then those
            of the canonical pose.
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor
    skin_weights: Tensor
    betas: Tensor
    training_poses: Tensor
    template: Template
    network: StyleUNet
    bounds: OffsetBounds
    info: AvatarInfo
    posing: PoseDependence | None = None

    def __len__(self) -> int:
        return len(self.means)

    @property
    def uv(self) -> Tensor:
        """[N,2] texture coordinates, origin lower left."""
        return self.template.uv

    @property
    def observed(self) -> Tensor:
        """[N] in [0,1]: how much of the Gaussian's surface the video showed."""
        return self.template.observed

    @property
    def head(self) -> Tensor:
        """[N] bool: on the head."""
        return self.template.head

    @property
    def skin_indices(self) -> Tensor:
        """[N,K] int64: joints of the skinning weights."""
        return self.template.skin_indices

    @property
    def observed_share(self) -> float:
        """Share of the surface's area that the video showed; the rest was invented."""
        return self.template.observed_share

    @cached_property
    def covars(self) -> Tensor:
        """[N,3,3] canonical covariances, metres²."""
        half = quaternion_to_matrix(self.quats) * self.scales[:, None, :]
        return half @ half.transpose(1, 2)

    @cached_property
    def lbs_weights(self) -> Tensor:
        """[N,J] dense skinning weights."""
        return dense_weights(self.skin_indices, self.skin_weights, self.training_poses.shape[1])

    @cached_property
    def _found(self) -> dict[str, object]:
        """What posing finds once: skeleton, expression basis, Gaussians of the last map pose."""
        return {}

    def pose(
        self,
        body: BodyModel,
        pose: Tensor,
        transl: Tensor | None = None,
        expression: Tensor | None = None,
        pose_strength: float | None = None,
        face: Tensor | None = None,
        mapped: Mapped | None = None,
    ) -> Posed:
        """Pose the avatar.

        Args:
            body: The model named in `info`.
            pose: [J,3] axis-angle, radians, joint 0 in the world.
            transl: [3] metres, world; zero by default.
            expression: [E] face actions, 0 neutral, 1 the full action; neutral by default.
            pose_strength: How far a full avatar's map pose is pulled to the training poses, [0,1]; as stored by
                default. The skeleton always follows `pose`.
            face: [N,3] what `face_offset` gives, in place of an expression.
            mapped: The Gaussians of another map pose (`mapped`), for poses so close to it that theirs would not differ.

        Raises:
            ValueError: If the body is another one, or the pose or expression has another shape or is not finite.
        """
        rotations = self._rotations(body, pose)
        kinematics = self._kinematics(body)
        place = torch.zeros(3) if transl is None else transl
        relative = kinematics.relative(rotations[None], place[None].to(self.means))[0]
        ready = self._ready(kinematics, rotations, pose_strength) if mapped is None else mapped
        means = ready.canonical.means
        if expression is not None:
            face = self.face_offset(body, expression)
        if face is not None:
            means = means + face
        means, covars = deform(means, ready.covars, ready.lbs_weights, relative)
        return Posed(means, covars, ready.canonical.colors, ready.canonical.opacities)

    def mapped(self, body: BodyModel, pose: Tensor, pose_strength: float | None = None) -> Mapped:
        """The canonical Gaussians of a map pose [J,3], for `pose`.

        Raises:
            ValueError: As `pose`.
        """
        return self._ready(self._kinematics(body), self._rotations(body, pose), pose_strength)

    def _rotations(self, body: BodyModel, pose: Tensor) -> Tensor:
        if body.name != self.info.body:
            raise ValueError(f"expected body {self.info.body!r}, got {body.name!r}; convert the motion, not the avatar")
        if tuple(pose.shape) != (body.n_joints, 3) or not bool(torch.isfinite(pose).all()):
            raise ValueError(f"expected a finite pose ({body.n_joints}, 3), got {tuple(pose.shape)}; leave frame out")
        return axis_angle_to_matrix(pose.to(self.means))

    def map_work(self, body: BodyModel) -> int:
        """Multiplications of a map pose's convolutions; 0 for a coarse avatar, whose Gaussians do not depend on it."""
        if self.posing is None:
            return 0
        if "work" not in self._found:
            self._found.pop("ready", None)
            still = torch.zeros(body.n_joints, 3)
            self._found["work"] = multiplications(self.network, lambda: self.mapped(body, still))
        return cast(int, self._found["work"])

    def _kinematics(self, body: BodyModel) -> Kinematics:
        if "kinematics" not in self._found:
            self._found["kinematics"] = Kinematics.of(body, self.betas)
        return cast(Kinematics, self._found["kinematics"])

    def _ready(self, kinematics: Kinematics, rotations: Tensor, strength: float | None) -> Mapped:
        """What skinning takes; a full avatar's is kept until the next map pose."""
        last = cast("Mapped | None", self._found.get("ready"))
        if last is not None and (self.posing is None or last.serves(rotations, strength)):
            return last
        if self.posing is None:
            turned = quaternion_to_matrix(self.quats)
            made = Canonical(self.means, turned, self.scales, self.opacities, self.colors, self.skin_weights)
            ready = Mapped(rotations, strength, made, self.covars, self.lbs_weights)
        else:
            maps = cast(
                PoseMaps,
                self._found.setdefault("maps", PoseMaps(self.template, kinematics, self.posing.reduction)),
            )
            made = self.posing.gaussians(maps, self.network, self.bounds, rotations, strength)
            dense = dense_weights(self.skin_indices, made.skin_weights, kinematics.n_joints)
            ready = Mapped(rotations, strength, made, made.covars(), dense)
        self._found["ready"] = ready
        return ready

    def face_offset(self, body: BodyModel, expression: Tensor) -> Tensor:
        """Canonical displacements [N,3], metres, of face actions [E]; what all actions do is found once.

        Raises:
            ValueError: If they are not as many as the body has, or not finite.
        """
        if tuple(expression.shape) != (body.n_expressions,) or not bool(torch.isfinite(expression).all()):
            raise ValueError(f"expected {body.n_expressions} finite face actions, got {tuple(expression.shape)}")
        if "expressions" not in self._found:
            self._found["expressions"] = expression_basis(body, self.betas, self.template)
        basis = cast(Tensor, self._found["expressions"])
        return torch.einsum("e,enk->nk", expression.to(basis), basis)

    def to_gaussians(self, posed: Posed | None = None) -> Gaussians:
        """Gaussians for export, canonical or posed.

        A skinned covariance is taken apart into axes and lengths, so there are no gradients (docs/avatar.md).
        """
        if posed is None:
            return Gaussians(self.means, self.quats, self.scales, self.opacities, self.colors)
        with torch.no_grad():
            covars = posed.covars.double()
            values, axes = torch.linalg.eigh((covars + covars.transpose(1, 2)) / 2)
            axes[:, :, 0] *= torch.sign(torch.linalg.det(axes))[:, None]
            quats, scales = matrix_to_quaternion(axes), values.clamp(min=0).sqrt()
        return Gaussians(
            posed.means, quats.to(posed.means), scales.to(posed.means), posed.opacities, posed.colors.clamp(0, 1)
        )


def network_config(template: Template, width: int, channels: int) -> StyleUNetConfig:
    """The StyleUNet for a template: `channels` offsets per pixel, bottleneck 8 where the maps allow it."""
    in_channels = template.maps().shape[1]
    bottleneck = min(8, template.map_size // 4)
    return StyleUNetConfig(
        map_size=template.map_size,
        width=width,
        bottleneck=bottleneck,
        in_channels=in_channels,
        out_channels=channels,
    )


@torch.no_grad()
def bake(
    template: Template,
    network: StyleUNet,
    bounds: OffsetBounds,
    betas: Tensor,
    training_poses: Tensor,
    info: AvatarInfo,
) -> Avatar:
    """Run the network once and keep the Gaussians.

    Args:
        template: Painted template.
        network: Trained (or untrained: then the avatar is the template).
        bounds: Largest offsets.
        betas: [S] shape.
        training_poses: [T,J,3].
        info: What the file shall say.
    """
    canonical = apply_offsets(template, template.gather(network(template.maps())), bounds)
    return _baked(canonical, template, network, bounds, betas, training_poses, info)


@torch.no_grad()
def bake_full(
    maps: PoseMaps,
    network: StyleUNet,
    bounds: OffsetBounds,
    posing: PoseDependence,
    betas: Tensor,
    training_poses: Tensor,
    info: AvatarInfo,
) -> Avatar:
    """A pose-dependent avatar; its stored Gaussians are those of the canonical pose.

    Args:
        maps: Maker of the pose maps.
        network: Trained StyleUNet on them.
        bounds: Largest offsets.
        posing: The pose-dependent part.
        betas: [S] shape.
        training_poses: [T,J,3].
        info: What the file shall say.
    """
    canonical = posing.gaussians(maps, network, bounds, maps.kinematics.canonical)
    avatar = _baked(canonical, maps.template, network, bounds, betas, training_poses, info)
    return replace(avatar, posing=posing)


def _baked(
    canonical: Canonical,
    template: Template,
    network: StyleUNet,
    bounds: OffsetBounds,
    betas: Tensor,
    training_poses: Tensor,
    info: AvatarInfo,
) -> Avatar:
    return Avatar(
        means=canonical.means,
        quats=matrix_to_quaternion(canonical.rotations),
        scales=canonical.scales,
        opacities=canonical.opacities,
        colors=canonical.colors.clamp(0, 1),
        skin_weights=canonical.skin_weights,
        betas=betas.detach().clone(),
        training_poses=training_poses.detach().clone(),
        template=template,
        network=network,
        bounds=bounds,
        info=info,
    )
