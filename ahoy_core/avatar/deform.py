"""From map offsets to Gaussians, and from canonical to posed Gaussians (paper section 3.1, "LBS deformation")."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor

from ahoy_core.body.lbs import blend_transforms
from ahoy_core.body.rotations import axis_angle_to_matrix
from ahoy_core.maps.template import Template

_FIXED_CHANNELS = 13
# Opacities are kept this far from 0 and 1, where a logit is infinite.
_LOGIT_EPS = 1e-6


def offset_channels(template: Template) -> int:
    """Map channels that `apply_offsets` reads.

    Position 3, rotation 3, log scale 3, opacity 1, colour 3, skinning logits K.
    """
    return _FIXED_CHANNELS + template.skin_weights.shape[1]


class OffsetBounds(BaseModel):
    """Largest offsets from the template; every one is `bound * tanh(raw)`, so that no network output can leave them."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    position: float = Field(default=0.08, gt=0, description="metres, per axis")
    rotation: float = Field(default=0.2, gt=0, description="radians, per axis")
    log_scale: float = Field(default=0.4, gt=0, description="natural logarithm of the factor")
    opacity: float = Field(default=6.0, gt=0, description="logit")
    color: float = Field(default=1.0, gt=0, description="sRGB")
    skin: float = Field(default=3.0, gt=0, description="logit of a skinning weight")


@dataclass(frozen=True)
class Canonical:
    """N differentiable Gaussians in the canonical pose.

    Attributes:
        means: [N,3] metres.
        rotations: [N,3,3].
        scales: [N,3] standard deviations, metres.
        opacities: [N] in (0,1).
        colors: [N,3] sRGB; unclamped, so that a colour outside [0,1] still gets a gradient.
        skin_weights: [N,K] of the joints in the template's `skin_indices`, rows sum to 1.
    """

    means: Tensor
    rotations: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor
    skin_weights: Tensor

    def covars(self) -> Tensor:
        """[N,3,3] covariances R S S R^T, metres²."""
        half = self.rotations * self.scales[:, None, :]
        return half @ half.transpose(1, 2)


def apply_offsets(template: Template, raw: Tensor, bounds: OffsetBounds) -> Canonical:
    """Gaussians = template + bounded offsets; raw = 0 gives the template.

    Args:
        template: N Gaussians.
        raw: [N,13+K] outputs of the network at the Gaussians' pixels, unbounded.
        bounds: Largest offsets.

    Raises:
        ValueError: If raw has another shape.
    """
    expected = (len(template), offset_channels(template))
    if tuple(raw.shape) != expected:
        raise ValueError(f"expected raw offsets {expected}, got {tuple(raw.shape)}; use Template.gather on the maps")
    position, rotation, log_scale, opacity, color, skin = torch.tanh(raw).split(
        [3, 3, 3, 1, 3, expected[1] - _FIXED_CHANNELS], dim=1
    )
    logits = torch.logit(template.opacities, eps=_LOGIT_EPS) + bounds.opacity * opacity[:, 0]
    return Canonical(
        means=template.means + bounds.position * position,
        rotations=template.rotations @ axis_angle_to_matrix(bounds.rotation * rotation),
        scales=template.scales * torch.exp(bounds.log_scale * log_scale),
        opacities=torch.sigmoid(logits),
        colors=template.colors + bounds.color * color,
        skin_weights=adjust_weights(template.skin_weights, bounds.skin * skin),
    )


def adjust_weights(weights: Tensor, logits: Tensor) -> Tensor:
    """Skinning weights [N,K] times exp(logits), normalised: w = softmax(log w0 + logits), with 0 staying 0."""
    # The largest logit among the joints that carry weight is taken out, so that neither overflow nor 0/0 can occur.
    carried = torch.where(weights > 0, logits, -torch.inf).amax(1, keepdim=True).detach()
    scaled = weights * torch.exp((logits - carried).clamp(max=0))
    return scaled / scaled.sum(1, keepdim=True)


def dense_weights(indices: Tensor, weights: Tensor, n_joints: int) -> Tensor:
    """Sparse skinning weights [N,K] of joints [N,K] as rows [N,J]."""
    return weights.new_zeros(len(weights), n_joints).scatter_add(1, indices, weights)


def deform(means: Tensor, covars: Tensor, lbs_weights: Tensor, relative: Tensor) -> tuple[Tensor, Tensor]:
    """D of paper section 3.1 for one pose: `deform_each` without its leading dimension.

    Args:
        means: [N,3] canonical, metres.
        covars: [N,3,3] canonical, metres².
        lbs_weights: [N,J] rows sum to 1.
        relative: [J,4,4] from `Kinematics.relative`.

    Returns:
        Posed means [N,3] and covars [N,3,3], world.
    """
    posed, turned = deform_each(means, covars, lbs_weights, relative[None])
    return posed[0], turned[0]


def deform_each(means: Tensor, covars: Tensor, lbs_weights: Tensor, relative: Tensor) -> tuple[Tensor, Tensor]:
    """Linear blend skinning of Gaussians in several poses: one blend of the weights serves all of them.

    Covariances follow the linear part A of the blend, A Sigma A^T: polynomial, so with gradients everywhere, where
    the polar rotation of A would jump at a twist of 180 degrees (docs/avatar.md).

    Args:
        means: [N,3] canonical, metres.
        covars: [N,3,3] canonical, metres².
        lbs_weights: [N,J] rows sum to 1.
        relative: [B,J,4,4] from `Kinematics.relative`.

    Returns:
        Posed means [B,N,3] and covars [B,N,3,3], world.
    """
    blend = blend_transforms(lbs_weights, relative)
    linear = blend[..., :3, :3]
    posed = (linear @ means[:, :, None])[..., 0] + blend[..., :3, 3]
    return posed, linear @ covars @ linear.transpose(-1, -2)
