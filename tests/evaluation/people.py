"""A capture made by an avatar, so that the same avatar must score perfectly on it, and everything else less."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import torch

from ahoy_core.avatar import Avatar, AvatarInfo
from ahoy_core.avatar.avatar import bake, network_config
from ahoy_core.avatar.deform import OffsetBounds, offset_channels
from ahoy_core.avatar.render import render
from ahoy_core.body.canonical import canonical_pose
from ahoy_core.body.convert import SkeletonPose, body_skeleton
from ahoy_core.body.rotations import axis_angle_to_matrix
from ahoy_core.captures import BodyTruth, Capture, TruePicture, View
from ahoy_core.conventions import Cameras, look_at, perspective_K
from ahoy_core.formats.images import to_uint8
from ahoy_core.maps.style_unet import StyleUNet
from tasks.evaluation.fitted import Fitted
from tests.avatar.scenes import body, dressed

SIZE, COUNT, HIDDEN_ROW = 64, 6, 40


@cache
def avatar(map_size: int = 32) -> Avatar:
    template = dressed(map_size)
    generator = torch.Generator().manual_seed(0)
    network = StyleUNet(network_config(template, 8, offset_channels(template)), generator)
    betas = body().default_betas
    return bake(template, network, OffsetBounds(), betas, canonical_pose(body())[None], AvatarInfo(body=body().name))


def motion(count: int, turn: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Poses turning and raising an arm, standing at the origin: [T,J,3], [T,3]."""
    pose = canonical_pose(body()).expand(count, -1, -1).clone()
    pose[:, 0, 2] += torch.linspace(0, turn, count)
    pose[:, body().joint_names.index("upperarm01.L"), 1] += torch.linspace(0, 0.8, count)
    return pose, torch.zeros(count, 3)


def truth_of(pose: torch.Tensor, transl: torch.Tensor) -> BodyTruth:
    skeleton = body_skeleton(body())
    at = SkeletonPose(axis_angle_to_matrix(pose.double()), (transl + skeleton.rest_joints[0]).double())
    return BodyTruth(skeleton, at, tuple(range(len(pose))), body().default_betas)


@cache
def cameras() -> dict[str, Cameras]:
    K = perspective_K(math.radians(40), SIZE, SIZE)
    eyes = {"front": (0.0, -3.5, 1.0), "side": (3.5, 0.0, 1.0)}
    return {
        name: Cameras(look_at(torch.tensor(eye), torch.tensor([0.0, 0.0, 0.9]))[None], K[None], SIZE, SIZE)
        for name, eye in eyes.items()
    }


def draw(pose: torch.Tensor, transl: torch.Tensor, camera: Cameras) -> TruePicture:
    posed = avatar().pose(body(), pose, transl)
    image, alpha = render(posed.means, posed.covars, posed.opacities, posed.colors, camera)
    a = alpha[0, 0].clamp(0, 1)
    straight = ((image[0] - 0.5 * (1 - a)) / a.clamp(min=1e-3)).clamp(0, 1)
    return TruePicture(straight, a, torch.ones_like(a, dtype=torch.bool))


def capture(folder: Path) -> Capture:
    """Two cameras, an input of `COUNT` frames whose lower part is hidden, and an unseen motion of three."""
    motions = {"view": motion(COUNT, 0.5), "pose": motion(3, -1.5)}

    def picture(view: View) -> TruePicture:
        poses, places = motions["pose" if view.moment == "pose" else "view"]
        found = draw(poses[view.frame], places[view.frame], cameras()[view.camera])
        if view.moment != "input":
            return found
        alpha = found.alpha.clone()
        alpha[HIDDEN_ROW:] = 0
        # A frame of a video has its background behind the person's soft edge.
        return replace(found, rgb=found.rgb * found.alpha + 0.5 * (1 - found.alpha), alpha=alpha)

    views = [View("view", name, t) for name in cameras() for t in (0, 3)]
    views += [View("pose", name, t) for name in cameras() for t in (0, 2)]
    return Capture(
        name="made", folder=folder, kind="ours", views=(*views, *(View("input", "front", t) for t in range(COUNT))),
        picture=picture, input_camera="front", cameras=cameras(),
        bodies={moment: truth_of(*values) for moment, values in motions.items()},
    )  # fmt: skip


def fitted(of: Capture) -> Fitted:
    """A perfect fit in another world: twice as large, turned and far away, as seen by a camera of that world."""
    poses, places = motion(COUNT, 0.5)
    front = cameras()["front"]
    frames = []
    for t in range(COUNT):
        seen = of.picture(View("view", "front", 0)) if t == 0 else draw(poses[t], places[t], front)
        frames.append(to_uint8(seen.rgb * seen.alpha + 0.5 * (1 - seen.alpha)))
    visible = np.stack(
        [(of.picture(View("input", "front", t)).alpha.numpy() * 255).astype(np.uint8) for t in range(COUNT)]
    )
    # The same picture: body and camera move together.
    shift = torch.tensor([5.0, -2.0, 1.0])
    viewmat = front.viewmats.clone()
    viewmat[:, :3, 3] -= viewmat[:, :3, :3] @ shift
    camera = Cameras(viewmat, front.Ks, SIZE, SIZE)
    used = np.ones(COUNT, dtype=bool)
    used[5] = False
    index = np.arange(COUNT)
    return Fitted(np.stack(frames), index, used, visible, poses, places + shift, body().default_betas, camera)
