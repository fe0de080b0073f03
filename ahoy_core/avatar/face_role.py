"""Face views by the role "face": new pictures of the head on a sphere round it, from the frames that show the face."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import torch
from torch import Tensor
from torch.nn.functional import interpolate, pad

from ahoy_core.avatar.head import FaceViews, body_shares, head_reach, head_zone
from ahoy_core.avatar.kinematics import Kinematics
from ahoy_core.conventions import GREY, Cameras, look_at, orbit_eyes
from ahoy_core.maps.template import Template
from ahoy_core.models.contracts import Face

AZIMUTHS: Final = (-60.0, -30.0, -10.0, 0.0, 10.0, 30.0, 60.0)
ELEVATIONS: Final = (-10.0, 10.0)
DISTANCE: Final = 1.0  # metres from the head's centre
FILLS: Final = 0.7  # share of the picture that the head's box fills
_NOTHING: Final = 0.02  # difference from grey below which a picture shows nothing


def face_cameras(template: Template, side: int, azimuths: Sequence[float] = AZIMUTHS) -> Cameras:
    """Cameras on a sphere round the bare head in the canonical pose, all looking at its middle.

    Args:
        template: the bare body.
        side: pixels of the square pictures.
        azimuths: degrees, at each of `ELEVATIONS`; by default those of a generator, which knows faces from the front.
    """
    head = template.means[template.head]
    centre, extent = (head.amax(0) + head.amin(0)) / 2, float((head.amax(0) - head.amin(0)).max())
    turns = torch.deg2rad(torch.tensor(azimuths))
    eyes = torch.cat([orbit_eyes(centre, DISTANCE, turns, math.radians(up)) for up in ELEVATIONS])
    focal = FILLS * side * DISTANCE / extent
    K = torch.tensor([[focal, 0, side / 2], [0, focal, side / 2], [0, 0, 1.0]])
    return Cameras(look_at(eyes, centre), K.expand(len(eyes), 3, 3).clone(), side, side)


@torch.no_grad()
def generated_faces(
    face: Face, observed: FaceViews, template: Template, kinematics: Kinematics, side: int = 128, seed: int = 0
) -> FaceViews:
    """Ask the role for the head from all sides, with the expression that most of the observed views are near.

    Args:
        face: the role.
        observed: the frames that show the face: its references.
        template: the bare body.
        kinematics: the person's skeleton.
        side: pixels of the pictures.
        seed: of the role.
    """
    cameras = face_cameras(template, side)
    middle = observed.expression.median(0).values
    references = torch.stack([_square(image, side) for image in observed.images])
    images = face(references, middle.expand(len(cameras), -1), cameras, seed)
    still = torch.eye(4).expand(kinematics.n_joints, 4, 4)
    shares = body_shares(template, still, cameras)
    zones = torch.stack(
        [head_zone(shares[n], head_reach(kinematics, template, still, cameras[n])) for n in range(len(cameras))]
    )
    shown = ((images - GREY).abs().amax(1) > _NOTHING).float()
    return FaceViews(
        images,
        zones * shown,
        zones,
        cameras,
        still.expand(len(cameras), -1, -1, -1),
        middle.expand(len(cameras), -1),
        torch.ones(len(cameras)),
    )


def _square(image: Tensor, side: int) -> Tensor:
    """A crop [3,h,w] in the middle of a grey square [3,side,side]."""
    _, height, width = image.shape
    longest = max(height, width)
    left, top = (longest - width) // 2, (longest - height) // 2
    whole = pad(image, (left, longest - width - left, top, longest - height - top), value=GREY)
    return interpolate(whole[None], (side, side), mode="bilinear", antialias=True, align_corners=False)[0]
