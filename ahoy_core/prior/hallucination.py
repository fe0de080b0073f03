"""A planned sequence from the coarse avatar's render to supervision (paper, section 3.2; registration of DESIGN 4)."""

from __future__ import annotations

from typing import Any, Final

import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from ahoy_core.avatar.avatar import Avatar
from ahoy_core.avatar.hallucinated import Supervision
from ahoy_core.avatar.render import render
from ahoy_core.body.model import BodyModel
from ahoy_core.body.rotations import axis_angle_to_matrix
from ahoy_core.conventions import GREY, Cameras
from ahoy_core.prior.bodymaps import light_maps
from ahoy_core.prior.completion import Pictures, pose_context
from ahoy_core.prior.framing import HEIGHT, WIDTH
from ahoy_core.prior.light import brightness_on
from ahoy_core.prior.sequences import PlannedSequence

Array = NDArray[Any]

RENDERED: Final = 2 * HEIGHT
"""Rows that a sequence is rendered with at least: small pictures are compared after the same area filter."""
_PERSON: Final = 0.06  # difference from grey above which a generated pixel shows somebody


def fine_cameras(cameras: Cameras, size: tuple[int, int] = (HEIGHT, WIDTH)) -> tuple[Cameras, int]:
    """The cameras that render a sequence for pictures of a size, and how many of their pixels are one of the picture's.

    Args:
        cameras: as planned, in the prior's framing.
        size: height and width of the pictures, of the planned aspect; `VideoModel.size`.
    """
    factor = max(1, RENDERED // size[0])
    scale = factor * size[0] / cameras.height
    Ks = cameras.Ks * torch.tensor([scale, scale, 1.0])[:, None]
    return Cameras(cameras.viewmats, Ks, factor * size[1], factor * size[0], cameras.camera_model), factor


@torch.no_grad()
def coarse_pictures(
    avatar: Avatar, body: BodyModel, sequence: PlannedSequence, size: tuple[int, int] = (HEIGHT, WIDTH)
) -> Pictures:
    """The coarse avatar in a planned sequence, with the observed share of every pixel and where its head is.

    The prior has never seen a real face: of a head it knows hair and back, and those it has put into the texture that
    the coarse avatar was trained on.

    Args:
        avatar: the coarse avatar.
        body: its body.
        sequence: T frames.
        size: height and width of the pictures.
    """
    cameras, factor = fine_cameras(sequence.cameras, size)
    frames, masks, shares = [], [], []
    kinds = torch.stack([avatar.observed, avatar.head.to(avatar.observed), torch.zeros(len(avatar))], dim=1)
    for t in range(len(sequence.pose)):
        posed = avatar.pose(body, sequence.pose[t], sequence.transl[t])
        shown = render(posed.means, posed.covars, posed.opacities, posed.colors, cameras[t])
        shared = render(posed.means, posed.covars, posed.opacities, kinds, cameras[t], background=0.0)
        frames.append(shown.images[0])
        masks.append(shown.alphas[0])
        shares.append(shared.images[0, :2])
    picture, alpha, share = (
        nn.functional.avg_pool2d(torch.stack(v).clamp(0, 1), factor) for v in (frames, masks, shares)
    )
    return Pictures(picture, alpha, share[:, :1], heads=share[:, 1:])


def sequence_context(body: BodyModel, betas: Tensor, sequence: PlannedSequence) -> tuple[Tensor, Tensor]:
    """Body maps [1,T,7,H/4,W/4] and azimuths [1,T] of a planned sequence of a shape `betas` [S]."""
    roots = axis_angle_to_matrix(sequence.pose[:, 0])
    return pose_context(body, _vertices(body, betas, sequence), roots, sequence.cameras)


def sequence_light(body: BodyModel, betas: Tensor, slope: Array, sequence: PlannedSequence) -> Tensor:
    """`Pictures.light` of a planned sequence.

    Args:
        body: of the avatar.
        betas: [S] its shape.
        slope: [3] of the light on its texture.
        sequence: T frames.
    """
    brightness = brightness_on(body, betas.numpy(), slope)
    return light_maps(body, _vertices(body, betas, sequence), sequence.cameras, brightness)


@torch.no_grad()
def _vertices(body: BodyModel, betas: Tensor, sequence: PlannedSequence) -> Tensor:
    return body(sequence.pose, betas[None].expand(len(sequence.pose), -1), sequence.transl).vertices


def silhouette_iou(made: Tensor, pictures: Pictures) -> float:
    """Intersection over union of the generated person and the coarse one, both found against the grey.

    Args:
        made: [T,3,H,W] as the prior made them.
        pictures: what it was given.
    """
    ours, theirs = ((frames - GREY).abs().amax(1) > _PERSON for frames in (made, pictures.frames))
    return float((ours & theirs).sum() / (ours | theirs).sum().clamp(min=1))


def rms_where(made: Tensor, truth: Tensor, weight: Tensor) -> float:
    """Root mean square colour difference of pictures [T,3,H,W] under weights [T,1,H,W]; NaN where nothing counts."""
    area = 3 * weight.sum()
    return float((((made - truth).square() * weight).sum() / area).sqrt()) if float(area) > 0 else float("nan")


def as_supervision(
    sequence: PlannedSequence, frames: Tensor, pictures: Pictures, registered: bool = True
) -> Supervision:
    """A hallucinated sequence as the full avatar takes it, registered by the motion that rendered its coarse input.

    Args:
        sequence: motion pose and cameras.
        frames: [T,3,H,W] hallucinated, observed pixels and heads pasted over.
        pictures: the coarse render, for coverage and alpha.
        registered: the prior was told where the body is; one that is not may paint it beside.
    """
    return Supervision(
        name=sequence.name,
        kind=sequence.kind,
        frames=frames,
        coverage=torch.minimum(pictures.coverage, pictures.mask)[:, 0],
        map_pose=sequence.map_pose,
        pose=sequence.pose,
        transl=sequence.transl,
        cameras=fine_cameras(sequence.cameras, (frames.shape[2], frames.shape[3]))[0],
        alphas=pictures.mask[:, 0],
        keeps_head=True,  # the coarse avatar's own (see `composited`): nothing else shows it from behind
        registered=registered,
    )
