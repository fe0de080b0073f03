"""Terms of the coarse objective (paper section 3.1, equation 1): masked photometric terms and regularisers."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor

from ahoy_core.avatar.deform import Canonical
from ahoy_core.maps.neighbours import neighbours
from ahoy_core.maps.template import Template


class LossWeights(BaseModel):
    """Weights of the terms; zero leaves a term out. L1 has weight 1 in both sums of equation 1."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    canonical: float = Field(default=1.0, ge=0, description="the V canonical views")
    observed: float = Field(default=1.0, ge=0, description="the observed frames")
    filled: float = Field(default=0.3, ge=0, le=1, description="a canonical pixel that was filled, not seen; seen: 1")
    outside: float = Field(default=0.05, ge=0, le=1, description="a canonical pixel beside the bare body")
    gradient: float = Field(default=0.5, ge=0, description="L1 of image differences beside every L1 of colours")
    head: float = Field(
        default=4.0, ge=0, description="factor on the canonical views' head, where errors are seen first"
    )
    alpha: float = Field(default=0.2, ge=0, description="L1 of the canonical views' alpha")
    empty: float = Field(default=0.3, ge=0, description="alpha of observed pixels that are surely background")
    solid: float = Field(default=0.2, ge=0, description="missing alpha where the person is seen")
    perceptual: float = Field(default=0.1, ge=0, description="ST-LPIPS of a patch of one picture a step")
    offset: float = Field(default=0.02, ge=0, description="squared offsets over 1 cm")
    strain: float = Field(default=0.1, ge=0, description="squared change of the offset over the way to a neighbour")
    scale: float = Field(default=0.01, ge=0, description="squared log scale factors")
    growth: float = Field(
        default=0.2, ge=0, description="squared log scale factors of axes that grew, on top of `scale`"
    )
    scale_change: float = Field(default=0.05, ge=0, description="squared difference of log scale factors of neighbours")
    color_change: float = Field(default=0.0, ge=0, description="squared difference of colour offsets of neighbours")
    lbs: float = Field(default=1.0, ge=0, description="squared distance to the body's skinning weights (section 3.3)")


def masked_l1(image: Tensor, target: Tensor, weight: Tensor, area: Tensor | None = None) -> Tensor:
    """Weighted sum of absolute differences of images [...,C,H,W], over C and the area.

    Args:
        image: [...,C,H,W].
        target: [...,C,H,W].
        weight: [...,1,H,W], at least 0.
        area: Pixels to divide by, a scalar; the sum of the weight by default. Less than one counts as one, so that an
            empty mask gives 0.
    """
    total = ((image - target).abs() * weight).sum()
    return total / (image.shape[-3] * (weight.sum() if area is None else area).clamp(min=1.0))


def gradient_l1(image: Tensor, target: Tensor, weight: Tensor, area: Tensor | None = None) -> Tensor:
    """`masked_l1` of horizontal and vertical differences; a difference counts as much as the lesser of its two pixels.

    Sharpens edges that a plain L1 leaves soft, at a fraction of the cost of SSIM.
    """
    error = image - target
    total = error.new_zeros(())
    for axis in (-1, -2):
        length = error.shape[axis] - 1
        step = error.narrow(axis, 1, length) - error.narrow(axis, 0, length)
        both = torch.minimum(weight.narrow(axis, 1, length), weight.narrow(axis, 0, length))
        total = total + masked_l1(step, torch.zeros_like(step), both, weight.sum() if area is None else area)
    return total


def photometric(image: Tensor, target: Tensor, weight: Tensor, gradient: float, area: Tensor | None = None) -> Tensor:
    """Masked L1 plus `gradient` times the masked L1 of image differences."""
    loss = masked_l1(image, target, weight, area)
    return loss + gradient * gradient_l1(image, target, weight, area) if gradient else loss


def canonical_weight(coverage: Tensor, alpha: Tensor, weights: LossWeights) -> Tensor:
    """Weight of canonical pixels: 1 where seen, `filled` where filled, `outside` beside the body.

    A fill must not outvote the video; and the outline of a canonical view is the bare body's, so that what lies beside
    it may well be clothes or hair.

    Args:
        coverage: [...,H,W] observed share of each pixel, [0,1].
        alpha: [...,H,W] the body's share of each pixel, [0,1].
        weights: `filled` and `outside`.
    """
    inside = weights.filled + (1 - weights.filled) * coverage.clamp(0, 1)
    return alpha * inside + (1 - alpha) * weights.outside


@dataclass(frozen=True)
class Neighbourhood:
    """Pairs of neighbours on the surface: first [E], second [E] int64, and the metres between them [E]."""

    first: Tensor
    second: Tensor
    distance: Tensor

    @classmethod
    def of(cls, template: Template) -> Neighbourhood:
        """Neighbours of a template; distances below a third of a pitch count as that."""
        first, second = neighbours(template).unbind(1)
        distance = (template.means[first] - template.means[second]).norm(dim=1)
        return cls(first, second, distance.clamp(min=template.pitch / 3))

    def change(self, values: Tensor) -> Tensor:
        """Mean over the pairs of the squared difference of values [N,C], summed over C."""
        return self._squared(values).sum() / max(1, len(self.first))

    def strain(self, offsets: Tensor) -> Tensor:
        """Mean over the pairs of (difference of offsets [N,3] over the distance)²; 0 for a shift of everything."""
        return (self._squared(offsets) / self.distance.square()).sum() / max(1, len(self.first))

    def _squared(self, values: Tensor) -> Tensor:
        return (values.index_select(0, self.first) - values.index_select(0, self.second)).square().sum(1)


def regularisers(canonical: Canonical, template: Template, around: Neighbourhood, weights: LossWeights) -> Tensor:
    """Distance from the template, and unlike offsets of neighbours; each term a mean over Gaussians or pairs.

    Without the second kind, a Gaussian near the outline of a person who is wider than the fitted body is drawn or
    stretched out to it on its own: spikes, which no other view and no other pose forgives.
    """
    offset = canonical.means - template.means
    growth = torch.log(canonical.scales / template.scales)
    skin = (canonical.skin_weights - template.skin_weights).square().sum(1).mean()
    return (
        weights.offset * (offset / 0.01).square().mean()
        + weights.strain * around.strain(offset)
        + weights.scale * growth.square().mean()
        + weights.growth * growth.clamp(min=0).square().mean()
        + weights.scale_change * around.change(growth)
        + weights.color_change * around.change(canonical.colors - template.colors)
        + weights.lbs * skin
    )
