"""A shot: one picture that supervises the full avatar, with everything that is needed to compare a render with it."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from ahoy_core.avatar.corrections import Tone
from ahoy_core.avatar.losses import LossWeights, masked_l1, photometric
from ahoy_core.avatar.render import Rendered
from ahoy_core.avatar.supervision import CoarseInputs, Frame, observed_frames
from ahoy_core.body.rotations import axis_angle_to_matrix
from ahoy_core.conventions import GREY, Cameras


@dataclass(frozen=True)
class Shot:
    """One picture, cut to the person.

    Attributes:
        group: Which map pose it belongs to.
        row: Its row among the corrections; -1 for an observed frame, which has none.
        target: [3,h,w] sRGB.
        weight: [1,h,w] weight of each pixel's colour.
        alpha: [1,h,w] alpha of the person, or None if it is not known.
        alpha_weight: [1,h,w] weight of each pixel's alpha.
        area: Pixels of person that the losses are divided by.
        camera: The camera, at `factor` times the target's resolution.
        factor: Pixels of the camera to one of the target.
        rotations: [J,3,3] local rotations of the LBS pose.
        transl: [3] metres.
        relative: [J,4,4] canonical -> posed, without corrections.
    """

    group: int
    row: int
    target: Tensor
    weight: Tensor
    alpha: Tensor | None
    alpha_weight: Tensor
    area: float
    camera: Cameras
    factor: int
    rotations: Tensor
    transl: Tensor
    relative: Tensor


def observed_shots(inputs: CoarseInputs, limit: int, weights: LossWeights) -> tuple[list[Shot], list[int], list[str]]:
    """Observed frames as shots, all of group 0, their numbers in the video, and notes on those left out.

    Alpha is 1 where the person is seen (weight `solid`), 0 where there is surely nobody (weight `empty`).
    """
    frames, notes = observed_frames(inputs, limit)
    rotations = axis_angle_to_matrix(inputs.pose.float())
    shots = [
        _observed(frame, rotations[frame.number], inputs.transl[frame.number].float(), weights) for frame in frames
    ]
    return shots, [frame.number for frame in frames], notes


def _observed(frame: Frame, rotations: Tensor, transl: Tensor, weights: LossWeights) -> Shot:
    scale = max(weights.alpha, 1e-6)  # `shot_loss` multiplies by it
    return Shot(
        group=0,
        row=-1,
        target=frame.target,
        weight=frame.weight,
        alpha=(frame.weight > frame.empty).float(),
        alpha_weight=(weights.solid * frame.weight + weights.empty * frame.empty) / scale,
        area=max(float(frame.weight.sum()), 1.0),
        camera=frame.camera,
        factor=1,
        rotations=rotations,
        transl=transl,
        relative=frame.relative,
    )


def at_target_resolution(rendered: Rendered, factor: int, tone: Tone | None = None) -> Rendered:
    """What a low-resolution camera would have seen: tone on the person alone, then the area filter."""
    image, alpha = rendered
    if tone is not None:
        behind = GREY * (1 - alpha)
        image = (image - behind) * tone.gain[:, :, None, None] + tone.bias[:, :, None, None] * alpha + behind
    if factor > 1:
        image, alpha = avg_pool2d(image, factor), avg_pool2d(alpha, factor)
    return Rendered(image, alpha)


def shot_loss(rendered: Rendered, shot: Shot, weights: LossWeights) -> Tensor:
    """Masked L1 of colours, of their differences and of alpha, over the person's area.

    Args:
        rendered: One picture [1,3,h,w] and alpha [1,1,h,w] at the target's resolution.
        shot: What it should be.
        weights: `gradient` and `alpha`.
    """
    area = torch.tensor(shot.area)
    loss = photometric(rendered.images[0], shot.target, shot.weight, weights.gradient, area)
    if shot.alpha is None:
        return loss
    return loss + weights.alpha * masked_l1(rendered.alphas[0], shot.alpha, shot.alpha_weight, area)
