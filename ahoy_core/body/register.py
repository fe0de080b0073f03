"""The surface of one body on another: where a vertex of the one lies in the other's pose and proportions."""

from __future__ import annotations

import torch
from torch import Tensor

from ahoy_core.body.convert import convert_body_pose, joint_map
from ahoy_core.body.model import BodyModel


def vertices_on(source: BodyModel, target: BodyModel) -> Tensor:
    """The source's average vertices, brought into the target's rest pose and proportions.

    The source is posed as the target rests; then each vertex is moved with its bones onto the target's joints, in
    proportion to where along a bone it lies. What is left are differences of flesh: project onto the nearest surface.

    Args:
        source: the body to carry over.
        target: the body to carry it to.

    Returns:
        [V,3] metres, beside the target's vertices at rest (pose, translation 0, default shape).
    """
    still = torch.zeros(1, target.n_joints, 3)
    there = target(still, target.default_betas[None], still[:, 0])
    pose, transl = convert_body_pose(target, source, still, still[:, 0])
    here = source(pose, source.default_betas[None], transl)
    vertices, joints = here.vertices[0], here.joints[0]
    shift = _shifts(source, target, joints, there.joints[0])
    ends, reach = _bones(source, joints)
    moved = torch.zeros_like(vertices)
    for joint in range(source.n_joints):
        weight = source.lbs_weights[:, joint]
        rows = torch.nonzero(weight > 0).flatten()
        along = ((vertices[rows] - joints[joint]) @ reach[joint] / reach[joint].square().sum().clamp_min(1e-9)).clamp(
            0, 1
        )
        both = torch.lerp(shift[joint][None], shift[ends[joint]][None], along[:, None])
        moved[rows] += weight[rows, None] * both
    return vertices + moved


def _shifts(source: BodyModel, target: BodyModel, here: Tensor, there: Tensor) -> Tensor:
    """[J,3] from each joint of the source to its partner's place; joints without one go with their parent."""
    pairs = joint_map(target.joint_names, source.joint_names)
    if pairs is None:
        pairs = {name: name for name in target.joint_names if name in source.joint_names}
    partner = {mine: other for other, mine in reversed(pairs.items())} | {source.joint_names[0]: target.joint_names[0]}
    shifts: list[Tensor] = []
    for joint, name in enumerate(source.joint_names):
        if name in partner:
            shifts.append(there[target.joint_names.index(partner[name])] - here[joint])
        else:
            shifts.append(shifts[source.parents[joint]])
    return torch.stack(shifts)


def _bones(body: BodyModel, joints: Tensor) -> tuple[list[int], Tensor]:
    """The joint at the end of each joint's bone (itself where it has none, or several), and the way there [J,3]."""
    children: list[list[int]] = [[] for _ in range(body.n_joints)]
    for joint, parent in enumerate(body.parents):
        if parent >= 0:
            children[parent].append(joint)
    ends = [own[0] if len(own) == 1 else joint for joint, own in enumerate(children)]
    return ends, joints[ends] - joints
