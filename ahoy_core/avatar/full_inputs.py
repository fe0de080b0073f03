"""What the full avatar is trained on, sorted into map poses (paper section 3.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from ahoy_core.avatar.full_config import FullConfig, Switches
from ahoy_core.avatar.hallucinated import Supervision, sequence_shots
from ahoy_core.avatar.head import FaceViews
from ahoy_core.avatar.kinematics import Kinematics
from ahoy_core.avatar.shots import Shot, observed_shots
from ahoy_core.avatar.supervision import CoarseInputs
from ahoy_core.body.rotations import axis_angle_to_matrix
from ahoy_core.maps.template import Template

# A frame is held out only where at least this many are left to learn from.
_MIN_FRAMES_FOR_HOLD_OUT = 4


@dataclass(frozen=True)
class FullInputs:
    """Everything equation 9 asks for.

    Attributes:
        observed: Frames, masks, poses, body; its canonical views are not used here.
        template: The painted template.
        base: [N,C] raw offsets of the coarse avatar on that template; None starts from the textured body.
        sequences: Hallucinated sequences; none where there is no prior.
        faces: Face views, or None.
        no_faces: Why there are none.
    """

    observed: CoarseInputs
    template: Template
    base: Tensor | None = None
    sequences: tuple[Supervision, ...] = ()
    faces: FaceViews | None = None
    no_faces: str = "no face views were given"


@dataclass(frozen=True)
class Plan:
    """Shots by map pose.

    Attributes:
        kinematics: The person's skeleton.
        rotations: [G,J,3,3] map poses, root included (it does not matter).
        hallucinated: Shots of each sequence.
        observed: Shots of each cluster of observed frames.
        held_out: An observed shot that is not trained on, and its number in the video.
        registered: [F] bool of the frames that have corrections: see `Supervision`.
        notes: What was left out, and why.
    """

    kinematics: Kinematics
    rotations: Tensor
    hallucinated: list[list[Shot]]
    observed: list[list[Shot]]
    held_out: tuple[int, Shot] | None
    registered: Tensor
    notes: list[str] = field(default_factory=list)


def make_plan(inputs: FullInputs, config: FullConfig) -> Plan:
    """Check the inputs, cut them into shots, and give every shot its map pose.

    Raises:
        ValueError: If there is nothing to learn from.
    """
    observed, switches = inputs.observed, config.switches
    kinematics = Kinematics.of(observed.body, observed.betas.float())
    frames, numbers, notes = observed_shots(observed, config.max_frames, config.weights)
    held_out = None
    if len(frames) > _MIN_FRAMES_FOR_HOLD_OUT:
        middle = len(frames) // 2
        held_out = (numbers[middle], frames.pop(middle))
    else:
        notes.append(f"no frame held out: {len(frames)} usable, more than {_MIN_FRAMES_FOR_HOLD_OUT} needed")
    sequences = () if switches.supervise == "none" else inputs.sequences
    groups, more = sequence_shots(sequences, kinematics, inputs.template, config.weights, switches.head_split)
    known = [sequence.registered for sequence, shots in zip(sequences, groups, strict=True) for _ in shots]
    registered = torch.tensor(known, dtype=torch.bool)
    notes += more
    if not len(registered) and not frames:
        raise ValueError("expected at least one usable frame or sequence, got none; see the notes of the stages before")
    sequence_poses = [axis_angle_to_matrix(sequence.map_pose.float()) for sequence in sequences]
    clusters, cluster_poses = _clusters(frames, config.observed_map_poses)
    everything = [*groups, *clusters]
    numbered = [[replace(shot, group=g) for shot in shots] for g, shots in enumerate(everything)]
    rotations, numbered = _map_poses([*sequence_poses, *cluster_poses], numbered, switches, kinematics)
    if held_out is not None:
        number, shot = held_out
        held_out = number, replace(shot, group=_nearest(shot.rotations, rotations))
    split = len(groups)
    kept = [shots for shots in numbered[:split] if shots]
    return Plan(kinematics, rotations, kept, numbered[split:], held_out, registered, notes)


def _map_poses(
    poses: Sequence[Tensor], groups: list[list[Shot]], switches: Switches, kinematics: Kinematics
) -> tuple[Tensor, list[list[Shot]]]:
    """Map poses as the switches have them: shared (default), one for all (C1), or each frame's own (C3)."""
    if not switches.pose_maps:
        return kinematics.canonical[None], [[replace(shot, group=0) for shot in shots] for shots in groups]
    if switches.shared_map_pose:
        return torch.stack(list(poses)), groups
    flat = [shot for shots in groups for shot in shots]
    number = iter(range(len(flat)))
    own = [[replace(shot, group=next(number)) for shot in shots] for shots in groups]
    return torch.stack([shot.rotations for shot in flat]), own


def _clusters(frames: Sequence[Shot], count: int) -> tuple[list[list[Shot]], list[Tensor]]:
    """Observed frames by their nearest of `count` poses that are far from each other, and those poses."""
    if not frames:
        return [], []
    rotations = torch.stack([shot.rotations for shot in frames])
    rows = rotations[:, 1:].flatten(1)
    chosen = [int((rows - rows.mean(0)).norm(dim=1).argmin())]
    while len(chosen) < min(count, len(frames)):
        away = torch.cdist(rows, rows[chosen]).amin(1)
        if float(away.max()) < 1e-3:
            break
        chosen.append(int(away.argmax()))
    nearest = torch.cdist(rows, rows[chosen]).argmin(1).tolist()
    groups = [[frames[i] for i, own in enumerate(nearest) if own == k] for k in range(len(chosen))]
    return groups, [rotations[i] for i in chosen]


def _nearest(rotations: Tensor, poses: Tensor) -> int:
    """The map pose [G,J,3,3] nearest to a pose [J,3,3], the root left out."""
    return int((poses[:, 1:] - rotations[1:]).flatten(1).norm(dim=1).argmin())
