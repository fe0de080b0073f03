"""Renders of the coarse avatar as sequences: equation 2 without the inversion (ablation B2).

They are what a prior repaints. Unpainted, they hold the full avatar to the coarse one where the video showed nothing,
in poses and from sides that the video does not have; where it did show something, coverage takes their weight away.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ahoy_core.avatar.avatar import Avatar
from ahoy_core.avatar.hallucinated import Supervision
from ahoy_core.avatar.render import render
from ahoy_core.body.model import BodyModel
from ahoy_core.conventions import PERSON_HEIGHT_SHARE, turntable_cameras

_FOV = math.radians(30)


@torch.no_grad()
def coarse_sequences(
    avatar: Avatar, body: BodyModel, map_poses: Tensor, views: int = 6, height: int = 192, width: int = 144
) -> tuple[Supervision, ...]:
    """One turn per map pose: the coarse avatar and its coverage from `views` sides.

    Args:
        avatar: The coarse avatar.
        body: Its body.
        map_poses: [G,J,3]; the root's rotation is taken out.
        views: Cameras round it.
        height: Pixels.
        width: Pixels.
    """
    made = []
    for number, pose in enumerate(map_poses):
        upright = torch.cat([torch.zeros_like(pose[:1]), pose[1:]])
        posed = avatar.pose(body, upright)
        low, high = posed.means.amin(0), posed.means.amax(0)
        focal = height / (2 * math.tan(_FOV / 2))
        radius = focal * float((high - low).max()) / (PERSON_HEIGHT_SHARE * height) + float((high - low)[:2].max()) / 2
        cameras = turntable_cameras((low + high) / 2, radius, views, 0.0, height, width, focal)
        shown = render(posed.means, posed.covars, posed.opacities, posed.colors, cameras)
        coverage = avatar.observed[:, None].expand(-1, 3).contiguous()
        covered = render(posed.means, posed.covars, posed.opacities, coverage, cameras, background=0.0)
        made.append(
            Supervision(
                name=f"coarse turn {number}",
                kind="turn",
                frames=shown.images.clamp(0, 1),
                coverage=covered.images[:, 0].clamp(0, 1),
                map_pose=upright,
                pose=upright.expand(views, -1, -1),
                transl=torch.zeros(views, 3),
                cameras=cameras,
                alphas=shown.alphas[:, 0].clamp(0, 1),
                keeps_head=True,
                registered=True,
            )
        )
    return tuple(made)
