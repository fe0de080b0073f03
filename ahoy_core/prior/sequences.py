"""Structured motions, planned from what the video left unseen (paper, section 3.2, "Supervision video generation")."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
import torch
from torch import Tensor

from ahoy_core.body.convert import convert_body_pose
from ahoy_core.body.model import BodyModel
from ahoy_core.body.packaged import PackagedBody, load_packaged_body
from ahoy_core.body.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from ahoy_core.conventions import Cameras
from ahoy_core.prior.corpus.poses import Angles, pose_rotations
from ahoy_core.prior.framing import orbit_cameras
from ahoy_core.prior.raster import rasterize

Kind = Literal["turn", "static"]

FRAMES: Final = 8
MIN_UNSEEN: Final = 0.02
"""Share of the body's area that a sequence must show for the first time; less is not worth half a minute."""
OBSERVED: Final = 0.5  # coverage from which a triangle counts as seen by the video

_RELAXED: Final[Angles] = {"abduct.L": 14, "abduct.R": 14, "elbow.L": 15, "elbow.R": 15, "spread.L": 4, "spread.R": 4}
ACTIONS: Final[dict[str, tuple[Kind, Angles]]] = {
    "standing": ("turn", _RELAXED),
    "arms lifted": ("turn", {**_RELAXED, "abduct.L": 75, "abduct.R": 75}),
    "both arms raised": ("turn", {**_RELAXED, "abduct.L": 155, "abduct.R": 155, "elbow.L": 20, "elbow.R": 20}),
    "stepping": ("turn", {**_RELAXED, "hip.L": 25, "knee.L": 25, "hip.R": -14, "raise.L": -20, "raise.R": 20}),
    "sitting": (
        "static",
        {**_RELAXED, "hip.L": 85, "hip.R": 85, "knee.L": 85, "knee.R": 85, "raise.L": 25, "raise.R": 25},
    ),
}
"""Target actions: a turn pairs one with a full rotation; sitting is no pose to turn in, so cameras go round it."""


@dataclass(frozen=True)
class PlannedSequence:
    """One motion that is worth hallucinating.

    Attributes:
        name: of the action.
        kind: "turn": the person turns before one camera; "static": one pose, several cameras.
        map_pose: [J,3] the configuration that all frames share, axis-angle, root upright.
        pose: [T,J,3] of each frame (for a turn with the root's rotation).
        transl: [T,3] metres, world.
        cameras: T cameras in the prior's framing.
        unseen: share of the body's area that it shows and the video did not.
        reason: why it is there, in words.
    """

    name: str
    kind: Kind
    map_pose: Tensor
    pose: Tensor
    transl: Tensor
    cameras: Cameras
    unseen: float
    reason: str


@dataclass(frozen=True)
class MotionPlan:
    """Sequences worth making, most revealing first, and the reasons against the others."""

    sequences: tuple[PlannedSequence, ...]
    dropped: dict[str, str]


def plan_motions(
    body: BodyModel,
    betas: Tensor,
    coverage: Tensor,
    frames: int = FRAMES,
    limit: int = 4,
    min_unseen: float = MIN_UNSEEN,
) -> MotionPlan:
    """Chooses structured motions that show what the video did not.

    Args:
        body: the run's body.
        betas: [S] the subject's shape.
        coverage: [F] in [0,1], observed share of each triangle of the body.
        frames: T of each sequence.
        limit: number of sequences at most.
        min_unseen: see `MIN_UNSEEN`.

    Raises:
        ValueError: when the coverage is not of this body.
    """
    if coverage.shape != (len(body.faces),):
        raise ValueError(f"expected coverage [{len(body.faces)}], one a triangle, got {tuple(coverage.shape)}")
    candidates, dropped = [], {}
    for name in ACTIONS:
        sequence, shown = _candidate(body, betas, coverage, name, frames)
        if sequence.unseen < min_unseen:
            dropped[name] = (
                f"shows {shown:.0%} of the body, of which the video left {sequence.unseen:.1%} unseen: less than "
                f"{min_unseen:.0%}"
            )
        else:
            candidates.append(sequence)
    candidates.sort(key=lambda sequence: -sequence.unseen)
    for sequence in candidates[limit:]:
        dropped[sequence.name] = f"shows {sequence.unseen:.1%} of unseen surface, {limit} other sequences show more"
    return MotionPlan(tuple(candidates[:limit]), dropped)


def _candidate(
    body: BodyModel, betas: Tensor, coverage: Tensor, name: str, frames: int
) -> tuple[PlannedSequence, float]:
    kind, angles = ACTIONS[name]
    rotations = _action_rotations(body, betas, angles)
    azimuths = torch.arange(frames) * (2 * math.pi / frames)
    turned = rotations.expand(frames, -1, -1, -1).clone()
    if kind == "turn":
        turned[:, 0] = _about_z(-azimuths)  # turning to one's right shows what a camera going to one's left sees
    transl, pose = torch.zeros(frames, 3), matrix_to_axis_angle(turned)
    rest = body(torch.zeros(1, body.n_joints, 3), betas[None], transl[:1]).vertices[0]
    vertices = body(pose, betas[None].expand(frames, -1), transl).vertices
    cameras = orbit_cameras(vertices, torch.zeros(frames) if kind == "turn" else azimuths)
    seen = _visible(body, vertices, cameras)
    areas = _areas(rest, body.faces) * ~body.regions["interior"][body.faces].all(1)
    areas = areas / areas.sum()
    shown, unseen = float(areas[seen].sum()), float((areas * (coverage < OBSERVED))[seen].sum())
    sequence = PlannedSequence(
        name=name,
        kind=kind,
        map_pose=matrix_to_axis_angle(rotations),
        pose=pose,
        transl=transl,
        cameras=cameras,
        unseen=unseen,
        reason=f"{'a full turn' if kind == 'turn' else 'from all sides'}, {name}: shows {unseen:.1%} of the body's "
        "surface that the video never showed",
    )
    return sequence, shown


def _action_rotations(body: BodyModel, betas: Tensor, angles: Angles) -> Tensor:
    """Parent-relative rotations [J,3,3] of an action: written for the packaged body, carried over to any other."""
    packaged = body if isinstance(body, PackagedBody) else load_packaged_body()
    rotations = pose_rotations(packaged, angles)
    if packaged is body:
        return rotations
    posed = matrix_to_axis_angle(rotations)[None]
    converted, _ = convert_body_pose(packaged, body, posed, torch.zeros(1, 3), target_betas=betas)
    return axis_angle_to_matrix(converted[0])


def _visible(body: BodyModel, vertices: Tensor, cameras: Cameras) -> Tensor:
    """Triangles [F] bool that some frame sees (at four times the prior's resolution)."""
    fine = Cameras(
        cameras.viewmats, _scaled(cameras.Ks, 4.0), 4 * cameras.width, 4 * cameras.height, cameras.camera_model
    )
    projected = fine.project(vertices)
    screen = torch.cat([projected.pixels, projected.depths[..., None]], -1).numpy().astype(np.float32)
    faces = body.faces.numpy().astype(np.int32)
    seen = np.zeros(len(faces) + 1, dtype=bool)
    for frame in screen:
        seen[rasterize(frame, faces, fine.height, fine.width).face] = True  # -1, nothing, is the spare last one
    return torch.from_numpy(seen[:-1])


def _scaled(Ks: Tensor, factor: float) -> Tensor:
    return Ks * torch.tensor([factor, factor, 1.0])[:, None]


def _areas(vertices: Tensor, faces: Tensor) -> Tensor:
    a, b, c = vertices[faces].unbind(1)
    return 0.5 * torch.linalg.cross(b - a, c - a).norm(dim=-1)


def _about_z(angles: Tensor) -> Tensor:
    c, s, zero, one = angles.cos(), angles.sin(), torch.zeros_like(angles), torch.ones_like(angles)
    return torch.stack([c, -s, zero, s, c, zero, zero, zero, one], -1).unflatten(-1, (3, 3))


def synchronise(poses: Sequence[Tensor], tolerance: float) -> tuple[list[tuple[int, ...]], list[int]]:
    """Matches frames of several videos of one pose, by pose distance.

    Args:
        poses: rotations [T_k,J,3,3] of each video, without the root's.
        tolerance: radians, root mean square over the joints, up to which two frames show the same pose.

    Returns:
        Groups with one frame of each video, each frame in one group at most, and the number of frames of each video
        that found no partner.
    """
    groups, used = [], [set[int]() for _ in poses]
    for frame in range(len(poses[0])):
        members = [frame]
        for k, other in enumerate(poses[1:], 1):
            distance = pose_distance(poses[0][frame], other)
            distance[list(used[k])] = math.inf
            best = int(distance.argmin())
            if float(distance[best]) > tolerance:
                break
            members.append(best)
        else:
            groups.append(tuple(members))
            for k, member in enumerate(members):
                used[k].add(member)
    return groups, [len(video) - len(taken) for video, taken in zip(poses, used, strict=True)]


def pose_distance(pose: Tensor, others: Tensor) -> Tensor:
    """Root mean square angle [T] in radians between rotations [J,3,3] and [T,J,3,3]."""
    trace = (pose[None] * others).sum((-1, -2))
    return torch.acos(((trace - 1) / 2).clamp(-1, 1)).square().mean(-1).sqrt()
