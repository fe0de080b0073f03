"""Hallucinated sequences as supervision: what a prior hands over, and what is made of it (paper sections 3.2, 3.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from ahoy_core.avatar.full_config import FullWeights
from ahoy_core.avatar.head import body_shares, head_reach, head_zone
from ahoy_core.avatar.kinematics import Kinematics
from ahoy_core.avatar.shots import Shot
from ahoy_core.body.rotations import axis_angle_to_matrix
from ahoy_core.conventions import GREY, Cameras
from ahoy_core.maps.template import Template
from ahoy_core.metrics.regions import mask_box

Kind = Literal["turn", "static"]

# The crop goes this share of the picture's height past the person: what spills over must be seen to be punished.
_MARGIN_SHARE = 0.04
_PERSON = 0.05  # difference from grey, or alpha, above which a pixel shows somebody


@dataclass(frozen=True)
class Supervision:
    """One hallucinated sequence: T pictures of one body configuration, as they were rendered and then repainted.

    Attributes:
        name: What it shows, for notes.
        kind: "turn": one clip in which the person turns; "static": one pose from several cameras, synchronised.
        frames: [T,3,h,w] sRGB over grey; lower resolution than the cameras' by a whole factor where the prior works so.
        coverage: [T,h,w] share of each pixel's surface that the video showed, [0,1].
        map_pose: [J,3] the configuration that all frames share, axis-angle.
        pose: [T,J,3] the LBS pose of each frame.
        transl: [T,3] metres, world.
        cameras: T cameras of the full resolution.
        alphas: [T,h,w] alpha of the person, or None where the generator gives none.
        keeps_head: Its head supervises, too. The paper leaves it out because a prior repaints faces badly; what was
            not repainted is all that shows the head from behind, and without it that part would be anything.
        registered: Its pictures show the body where `pose` and `cameras` put it, because that is what they were
            rendered or repainted from; others were found there, and may be off by more.
    """

    name: str
    kind: Kind
    frames: Tensor
    coverage: Tensor
    map_pose: Tensor
    pose: Tensor
    transl: Tensor
    cameras: Cameras
    alphas: Tensor | None = None
    keeps_head: bool = False
    registered: bool = False

    def __post_init__(self) -> None:
        count, size = len(self.frames), tuple(self.frames.shape[2:])
        rows = {"pose": len(self.pose), "transl": len(self.transl), "cameras": len(self.cameras)}
        if any(number != count for number in rows.values()):
            raise ValueError(f"sequence {self.name!r}: expected {count} rows each, one a frame, got {rows}")
        for name in ("coverage", "alphas"):
            value = getattr(self, name)
            if value is not None and tuple(value.shape) != (count, *size):
                raise ValueError(f"sequence {self.name!r}: expected {name} {(count, *size)}, got {tuple(value.shape)}")
        full = (self.cameras.height, self.cameras.width)
        if full[0] % size[0] or full[1] % size[1] or full[0] // size[0] != full[1] // size[1]:
            raise ValueError(
                f"sequence {self.name!r}: expected frames smaller than the cameras' {full} by one whole factor, got "
                f"{size}; store the cameras that rendered the sequence, and never upsample it"
            )

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def factor(self) -> int:
        """Pixels of the camera to one of the frames."""
        return self.cameras.height // self.frames.shape[2]


def sequence_shots(
    sequences: Sequence[Supervision],
    kinematics: Kinematics,
    template: Template,
    weights: FullWeights,
    head_split: bool,
) -> tuple[list[list[Shot]], list[str]]:
    """Every sequence as shots, and a note on each frame that was left out.

    Args:
        sequences: The sequences; group g of the shots is sequence g.
        kinematics: The person's skeleton.
        template: The bare body, to tell head from body.
        weights: Weights of covered pixels and of those beside the person.
        head_split: Leave out the head's pixels (equation 6) of sequences that do not keep their head.

    Returns:
        Per sequence its usable shots; and notes.
    """
    groups: list[list[Shot]] = []
    notes: list[str] = []
    row = 0
    for number, sequence in enumerate(sequences):
        shots: list[Shot] = []
        for index in range(len(sequence)):
            if _fault(sequence, index):
                notes.append(f"sequence {sequence.name!r}, frame {index} not used: {_fault(sequence, index)}")
                continue
            without_head = head_split and not sequence.keeps_head
            shots.append(_shot(sequence, index, number, row, kinematics, template, weights, without_head))
            row += 1
        groups.append(shots)
    return groups, notes


def _fault(sequence: Supervision, index: int) -> str:
    values = [sequence.frames[index], sequence.coverage[index], sequence.pose[index], sequence.transl[index]]
    values += [] if sequence.alphas is None else [sequence.alphas[index]]
    if not all(bool(torch.isfinite(value).all()) for value in values):
        return "a picture, alpha, coverage or pose is not finite"
    return "" if bool(torch.isfinite(sequence.map_pose).all()) else "the map pose is not finite"


@torch.no_grad()
def _shot(
    sequence: Supervision,
    index: int,
    group: int,
    row: int,
    kinematics: Kinematics,
    template: Template,
    weights: FullWeights,
    without_head: bool,
) -> Shot:
    camera, factor = sequence.cameras[index], sequence.factor
    rotations = axis_angle_to_matrix(sequence.pose[index].float())
    transl = sequence.transl[index].float()
    relative = kinematics.relative(rotations[None], transl[None])[0]
    small = _reduced(camera, factor)
    shares = body_shares(template, relative, small)[0]
    target = sequence.frames[index].float()
    bare = shares.sum(0)
    alpha = sequence.alphas[index].float() if sequence.alphas is not None else None
    person = alpha if alpha is not None else ((target - GREY).abs().amax(0) > _PERSON).float().maximum(bare)
    weight = person + (1 - person) * weights.outside
    weight = weight * (1 - (1 - weights.covered) * sequence.coverage[index].float().clamp(0, 1))
    if without_head:
        weight = weight * (1 - head_zone(shares, head_reach(kinematics, template, relative, small)))
    y0, y1, x0, x1 = _crop(person.maximum(bare))
    cut = (slice(None), slice(y0, y1), slice(x0, x1))
    return Shot(
        group=group,
        row=row,
        target=target[cut],
        weight=weight[None][cut],
        alpha=None if alpha is None else alpha[None][cut],
        alpha_weight=weight[None][cut],
        # Not of the weights: what coverage takes away must not come back through a smaller divisor.
        area=max(float(person.sum()), 1.0),
        camera=_cropped(camera, x0 * factor, y0 * factor, x1 * factor, y1 * factor),
        factor=factor,
        rotations=rotations,
        transl=transl,
        relative=relative,
    )


def _crop(person: Tensor) -> tuple[int, int, int, int]:
    height, width = person.shape
    if not bool((person > _PERSON).any()):
        return 0, height, 0, width
    x0, y0, x1, y1 = mask_box(person * (person > _PERSON), 2 + round(_MARGIN_SHARE * height))
    return y0, y1, x0, x1


def _reduced(camera: Cameras, factor: int) -> Cameras:
    """The camera of a picture smaller by a factor."""
    scale = torch.tensor([1.0 / factor, 1.0 / factor, 1.0])[:, None]
    size = camera.width // factor, camera.height // factor
    return Cameras(camera.viewmats, camera.Ks * scale, *size, camera.camera_model)


def _cropped(camera: Cameras, x0: int, y0: int, x1: int, y1: int) -> Cameras:
    """The camera of a box of its picture."""
    Ks = camera.Ks.clone()
    Ks[:, 0, 2] -= x0
    Ks[:, 1, 2] -= y0
    return Cameras(camera.viewmats, Ks, x1 - x0, y1 - y0, camera.camera_model)
