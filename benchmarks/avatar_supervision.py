"""Supervision of the full avatar made from captures' true pictures: consistent, or jittered as a generator's would be.

Jitter, per frame unless it says otherwise, all from one seed:

- pose: every corrected joint is turned by a normal axis-angle of 2 degrees an axis (the stored pose, not the picture);
- place: the person is shifted by a normal 1 cm an axis;
- colour: gain exp(N(0, 0.08)) and bias N(0, 0.03) per channel, on the person;
- shape: the picture is warped by a smooth field (a 4x4 grid of normal shifts of 1 pixel, bicubic);
- face: on the head the warp is three times as strong: generated faces are what a video prior gets wrong most.

The map pose of a sequence is the true one, jittered once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import grid_sample, interpolate

from ahoy_core.avatar.corrections import corrected_joints
from ahoy_core.avatar.hallucinated import Supervision
from ahoy_core.avatar.head import FaceViews, body_shares, head_reach, head_zone
from ahoy_core.avatar.kinematics import Kinematics
from ahoy_core.body.packaged import PackagedBody
from ahoy_core.body.rotations import axis_angle_to_matrix, matrix_to_axis_angle, so3_exp
from ahoy_core.captures import Capture, View
from ahoy_core.conventions import GREY, Cameras
from ahoy_core.maps.template import Template
from ahoy_core.metrics.regions import mask_box

TRAINED = (0, 12, 24, 36)
TESTED = (6, 18, 30, 42)
POSE_STD, PLACE_STD, GAIN_STD, BIAS_STD, WARP_STD, FACE_FACTOR = 0.035, 0.01, 0.08, 0.03, 1.0, 3.0
_FACE_SIDE = 64


def true_sequences(capture: Capture, pose: Tensor, transl: Tensor, cameras: Sequence[str]) -> tuple[Supervision, ...]:
    """One static sequence per trained frame: the true pictures of the chosen cameras, all of it unseen by the video."""
    made = []
    chosen = [capture.cameras[name] for name in cameras]
    together = Cameras(
        torch.cat([c.viewmats for c in chosen]),
        torch.cat([c.Ks for c in chosen]),
        chosen[0].width,
        chosen[0].height,
    )
    for frame in TRAINED:
        pictures = [capture.picture(View("view", name, frame)) for name in cameras]
        rgb, alphas = torch.stack([one.rgb for one in pictures]), torch.stack([one.alpha for one in pictures])
        made.append(
            Supervision(
                name=f"frame {frame}",
                kind="static",
                frames=rgb * alphas[:, None] + GREY * (1 - alphas[:, None]),
                coverage=torch.zeros_like(alphas),
                map_pose=pose[frame],
                pose=pose[frame].expand(len(cameras), -1, -1),
                transl=transl[frame].expand(len(cameras), -1),
                cameras=together,
                alphas=alphas,
            )
        )
    return tuple(made)


def inconsistent(
    sequences: Sequence[Supervision], body: PackagedBody, template: Template, betas: Tensor, seed: int
) -> tuple[Supervision, ...]:
    """The same sequences as a generator might have made them: see the module's docstring."""
    generator = torch.Generator().manual_seed(seed)
    joints, kinematics = corrected_joints(body), Kinematics.of(body, betas)
    return tuple(_jittered(sequence, joints, template, kinematics, generator) for sequence in sequences)


def _jittered(
    sequence: Supervision, joints: Tensor, template: Template, kinematics: Kinematics, generator: torch.Generator
) -> Supervision:
    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    count = len(sequence)
    assert sequence.alphas is not None
    frames, alphas = [], []
    for index in range(count):
        zone = _zone(sequence, index, template, kinematics)
        field = _smooth(WARP_STD * normal(1, 2, 4, 4), zone) + (FACE_FACTOR - 1) * zone * _smooth(
            WARP_STD * normal(1, 2, 8, 8), zone
        )
        both = _warp(torch.cat([sequence.frames[index], sequence.alphas[index][None]]), field)
        gain, bias = torch.exp(GAIN_STD * normal(3, 1, 1)), BIAS_STD * normal(3, 1, 1)
        person = (both[:3] - GREY * (1 - both[3:])) * gain + bias * both[3:]
        frames.append((person + GREY * (1 - both[3:])).clamp(0, 1))
        alphas.append(both[3])
    turned = so3_exp(POSE_STD * normal(count + 1, len(joints), 3))
    poses = torch.cat([sequence.pose, sequence.map_pose[None]])
    rotations = axis_angle_to_matrix(poses)
    rotations[:, joints] = rotations[:, joints] @ turned
    poses = matrix_to_axis_angle(rotations)
    return replace(
        sequence,
        frames=torch.stack(frames),
        alphas=torch.stack(alphas),
        pose=poses[:count],
        map_pose=poses[count],
        transl=sequence.transl + PLACE_STD * normal(count, 3),
    )


def _zone(sequence: Supervision, index: int, template: Template, kinematics: Kinematics) -> Tensor:
    relative = kinematics.relative(axis_angle_to_matrix(sequence.pose[index])[None], sequence.transl[index][None])[0]
    camera = sequence.cameras[index]
    shares = body_shares(template, relative, camera)[0]
    return head_zone(shares, head_reach(kinematics, template, relative, camera))


def _smooth(grid: Tensor, like: Tensor) -> Tensor:
    return interpolate(grid, size=like.shape[-2:], mode="bicubic", align_corners=True)[0]


def _warp(image: Tensor, field: Tensor) -> Tensor:
    """The picture [C,H,W] read at each pixel plus a field [2,H,W] of pixels (x, y)."""
    height, width = image.shape[1:]
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    at = torch.stack([(x + field[0] + 0.5) * 2 / width - 1, (y + field[1] + 0.5) * 2 / height - 1], -1)
    return grid_sample(image[None], at[None], padding_mode="border", align_corners=False)[0]


def true_faces(sequences: Sequence[Supervision], template: Template, kinematics: Kinematics, E: int) -> FaceViews:
    """Face views: the head's box of the true pictures, in boxes of one size."""
    images, alphas, weights, viewmats, Ks, relatives = [], [], [], [], [], []
    for sequence in sequences:
        for index in range(len(sequence)):
            camera = sequence.cameras[index]
            rotations = axis_angle_to_matrix(sequence.pose[index])
            relative = kinematics.relative(rotations[None], sequence.transl[index][None])[0]
            zone = _zone(sequence, index, template, kinematics)
            x0, y0, x1, y1 = mask_box(zone)
            left = min(max((x0 + x1 - _FACE_SIDE) // 2, 0), camera.width - _FACE_SIDE)
            top = min(max((y0 + y1 - _FACE_SIDE) // 2, 0), camera.height - _FACE_SIDE)
            box = (..., slice(top, top + _FACE_SIDE), slice(left, left + _FACE_SIDE))
            K = camera.Ks.clone()
            K[:, 0, 2] -= left
            K[:, 1, 2] -= top
            assert sequence.alphas is not None
            images.append(sequence.frames[index][box])
            alphas.append(sequence.alphas[index][box])
            weights.append(zone[box])
            viewmats.append(camera.viewmats)
            Ks.append(K)
            relatives.append(relative)
    cameras = Cameras(torch.cat(viewmats), torch.cat(Ks), _FACE_SIDE, _FACE_SIDE)
    return FaceViews(
        torch.stack(images),
        torch.stack(alphas),
        torch.stack(weights),
        cameras,
        torch.stack(relatives),
        torch.zeros(len(images), E),
    )
