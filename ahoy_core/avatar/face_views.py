"""Face views out of the observed video: where the prior gives none, the frames that show the face are the face views.

They count once more what the observed loss counts already, on head Gaussians alone and with the head's expression, so
that a blink or an open mouth does not blur the neutral face.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ahoy_core.avatar.head import FaceViews, body_shares, head_joint, head_reach, head_zone
from ahoy_core.avatar.kinematics import Kinematics
from ahoy_core.avatar.supervision import CoarseInputs, unit_range
from ahoy_core.body.rotations import axis_angle_to_matrix
from ahoy_core.conventions import GREY, Cameras
from ahoy_core.maps.template import Template
from ahoy_core.metrics.regions import mask_box

MAX_VIEWS = 8
MIN_SEEN = 0.6
"""Share of the bare head that the visible mask must hold."""
MIN_AREA = 64
"""Pixels of head; below, there is nothing of a face to learn."""
FACING = 0.2
"""Cosine between where the face looks and where the camera is; below, it is a profile from behind."""
SHARE = 0.15
"""Of the head's weight. At the whole of it the sides of a head that the frames show from one side alone fall apart."""
_MARGIN = 3


class _Candidate(NamedTuple):
    number: int
    area: float
    zone: Tensor
    relative: Tensor


@torch.no_grad()
def observed_faces(
    inputs: CoarseInputs, template: Template, kinematics: Kinematics, expression: Tensor | None = None
) -> tuple[FaceViews | None, str]:
    """The frames with the most face in them as face views, or None and why.

    Args:
        inputs: Observed frames.
        template: The bare body.
        kinematics: The person's skeleton.
        expression: [T,E] face actions of the frames; neutral by default.
    """
    found = [c for number in range(len(inputs.frames)) if (c := _candidate(inputs, template, kinematics, number))]
    if not found:
        return None, "the face is never seen (no frame shows most of a head of 64 pixels that looks this way)"
    found = sorted(found, key=lambda c: (-c.area, c.number))[:MAX_VIEWS]
    boxes = [mask_box(c.zone, _MARGIN) for c in found]
    height, width = inputs.frames.shape[2:]
    tall = min(height, max(y1 - y0 for _, y0, _, y1 in boxes))
    wide = min(width, max(x1 - x0 for x0, _, x1, _ in boxes))
    images, alphas, weights, Ks = [], [], [], []
    for candidate, (x0, y0, x1, y1) in zip(found, boxes, strict=True):
        top = min(max((y0 + y1 - tall) // 2, 0), height - tall)
        left = min(max((x0 + x1 - wide) // 2, 0), width - wide)
        cut = (..., slice(top, top + tall), slice(left, left + wide))
        mask = unit_range(inputs.masks[candidate.number])[cut]
        images.append(unit_range(inputs.frames[candidate.number])[cut] * mask + GREY * (1 - mask))
        alphas.append(mask)
        # Only the seen part counts: beside it may be background or something in front of the head.
        weights.append(candidate.zone[cut] * mask)
        K = inputs.K.float().clone()
        K[0, 2] -= left
        K[1, 2] -= top
        Ks.append(K)
    cameras = Cameras(inputs.viewmat.float().expand(len(found), 4, 4), torch.stack(Ks), wide, tall)
    numbers = [c.number for c in found]
    actions = torch.zeros(len(found), inputs.body.n_expressions) if expression is None else expression[numbers].float()
    relative = torch.stack([c.relative for c in found])
    pictures = torch.stack(images), torch.stack(alphas), torch.stack(weights)
    return FaceViews(*pictures, cameras, relative, actions, torch.full((len(found),), SHARE)), ""


def _candidate(inputs: CoarseInputs, template: Template, kinematics: Kinematics, number: int) -> _Candidate | None:
    numbers = (inputs.pose[number], inputs.transl[number], unit_range(inputs.frames[number]))
    if not bool(inputs.used[number]) or not all(bool(torch.isfinite(value).all()) for value in numbers):
        return None
    rotations = axis_angle_to_matrix(inputs.pose[number].float())
    relative = kinematics.relative(rotations[None], inputs.transl[number].float()[None])[0]
    turn = relative[head_joint(template, kinematics.n_joints)]
    center = turn[:3, :3] @ template.means[template.head].mean(0) + turn[:3, 3]
    height, width = inputs.frames.shape[2:]
    camera = Cameras(inputs.viewmat.float()[None], inputs.K.float()[None], width, height)
    toward = torch.nn.functional.normalize(camera.centers[0] - center, dim=0)
    if float(toward @ (turn[:3, :3] @ torch.tensor([0.0, -1.0, 0.0]))) < FACING:
        return None
    shares = body_shares(template, relative, camera)[0]
    head = shares[0] > 0.5
    mask = torch.nan_to_num(unit_range(inputs.masks[number]))
    if float(head.sum()) < MIN_AREA or float((mask * head).sum()) < MIN_SEEN * float(head.sum()):
        return None
    zone = head_zone(shares, head_reach(kinematics, template, relative, camera))
    return _Candidate(number, float((mask * head).sum()), zone, relative)
