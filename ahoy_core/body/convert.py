"""Poses across bodies: `convert_pose` is the only bridge (captures' full rig, the packaged body, the SMPL family).

A pose is a set of joint rotations over a rest pose. What carries over is each joint's rotation in the world: where two
skeletons share their rest pose, as a rig and its reduced form do, it carries over as it is; where they don't (T-pose
against A-pose), it is first turned by the swing that takes the target's rest bone onto the source's.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from ahoy_core.body.lbs import forward_kinematics, global_rotations, local_rotations
from ahoy_core.body.model import BodyModel
from ahoy_core.body.packaged import PackagedBody
from ahoy_core.body.rotations import axis_angle_to_matrix, matrix_to_axis_angle, nearest_rotation
from ahoy_core.body.smpl_names import JOINT_NAMES, is_limb, packaged_from_smpl, smpl_from_packaged, within_smpl


@dataclass(frozen=True)
class Skeleton:
    """Joints of a body at rest, in our axes (z up, facing -y, left towards +x).

    Attributes:
        joint_names: J names.
        parents: parent of each joint, -1 for the root at index 0, parents before children.
        rest_joints: [J,3] metres.
        rest_pose: names the rest pose; skeletons of one name need no alignment, whatever their proportions.
    """

    joint_names: tuple[str, ...]
    parents: tuple[int, ...]
    rest_joints: Tensor
    rest_pose: str

    def __post_init__(self) -> None:
        if not len(self.joint_names) == len(self.parents) == len(self.rest_joints):
            raise ValueError(
                f"expected one name, parent and rest joint each, got {len(self.joint_names)}, {len(self.parents)} and "
                f"{len(self.rest_joints)}"
            )


@dataclass(frozen=True)
class SkeletonPose:
    """T poses of a skeleton.

    Attributes:
        rotations: [T,J,3,3] parent-relative, in the axes of rest space; the root's in the world.
        root: [T,3] the root joint's position in the world, metres.
    """

    rotations: Tensor
    root: Tensor


def convert_pose(
    source: Skeleton,
    target: Skeleton,
    pose: SkeletonPose,
    joints: Mapping[str, str] | None = None,
    aligned: Callable[[str], bool] = lambda name: True,
) -> SkeletonPose:
    """Carries poses from one skeleton to another.

    Args:
        source: skeleton that `pose` belongs to.
        target: skeleton wanted.
        pose: T poses of `source`.
        joints: target joint -> source joint, for joints of different names; by default joints of equal names. The roots
            always correspond. A target joint without a source keeps its rest rotation relative to its parent; the
            rotation of a source joint without a target is passed on to its descendants.
        aligned: of a target joint's name, whether its rest bone is to be swung onto the source's. Where both rest poses
            agree but their joints are placed differently (a spine, a foot), it should not be.

    Returns:
        T poses of `target`, with the source's root position.

    Raises:
        ValueError: when `pose` has another number of joints, or `joints` names one that a skeleton lacks.
    """
    if pose.rotations.shape[1:] != (len(source.parents), 3, 3):
        expected = f"[T,{len(source.parents)},3,3]"
        raise ValueError(f"expected rotations {expected} of the source skeleton, got {tuple(pose.rotations.shape)}")
    pairs = _pairs(source, target, joints)
    world = global_rotations(pose.rotations, source.parents)
    swings = _swings(source, target, pairs, aligned).to(world)
    turned: list[Tensor] = []
    for joint, parent in enumerate(target.parents):
        turned.append(world[:, pairs[joint]] @ swings[joint] if joint in pairs else turned[parent])
    return SkeletonPose(local_rotations(torch.stack(turned, dim=1), target.parents), pose.root)


def _pairs(source: Skeleton, target: Skeleton, joints: Mapping[str, str] | None) -> dict[int, int]:
    """Target joint -> source joint."""
    if joints is None:
        joints = {name: name for name in target.joint_names if name in source.joint_names}
    missing = sorted(set(joints) - set(target.joint_names)) + sorted(set(joints.values()) - set(source.joint_names))
    if missing:
        raise ValueError(f"expected joints that the skeletons have, got {missing}; check the mapping's direction")
    named = {target.joint_names.index(t): source.joint_names.index(s) for t, s in joints.items()}
    return {**named, 0: 0}


def _swings(source: Skeleton, target: Skeleton, pairs: Mapping[int, int], aligned: Callable[[str], bool]) -> Tensor:
    """[J,3,3]: the least rotations that take the target's rest bones onto the source's; identity for joints without.

    A joint with several children (wrist) or none (finger tip) has no bone of its own and swings with its parent.
    """
    swings = torch.eye(3, dtype=torch.float64).repeat(len(target.parents), 1, 1)
    if source.rest_pose == target.rest_pose:
        return swings
    for joint in sorted(pairs):
        if joint == 0 or not aligned(target.joint_names[joint]):
            continue
        children = [c for c in pairs if c != joint and _next_paired(target, c, pairs) == joint]
        if len(children) == 1:
            there = source.rest_joints[pairs[children[0]]] - source.rest_joints[pairs[joint]]
            here = target.rest_joints[children[0]] - target.rest_joints[joint]
            swings[joint] = _swing(here.double(), there.double())
        else:
            swings[joint] = swings[_next_paired(target, joint, pairs)]
    return swings


def _next_paired(skeleton: Skeleton, joint: int, pairs: Mapping[int, int]) -> int:
    """The nearest ancestor of a joint that has a partner, -1 above the root."""
    joint = skeleton.parents[joint]
    while joint >= 0 and joint not in pairs:
        joint = skeleton.parents[joint]
    return joint


def _swing(a: Tensor, b: Tensor) -> Tensor:
    """The least rotation [3,3] that takes direction a [3] to direction b [3]; any half turn when they are opposite."""
    axis, cosine = torch.linalg.cross(a, b), torch.dot(a, b)
    sine = axis.norm()
    if sine <= 1e-9 * a.norm() * b.norm():
        if cosine >= 0:
            return torch.eye(3, dtype=a.dtype)
        axis = torch.linalg.cross(a, torch.eye(3, dtype=a.dtype)[a.abs().argmin()])
    return axis_angle_to_matrix(axis / axis.norm() * torch.atan2(sine, cosine))


def body_skeleton(body: BodyModel, betas: Tensor | None = None) -> Skeleton:
    """A body's skeleton, for a shape [S] (an average adult by default)."""
    betas = (body.default_betas if betas is None else betas)[None]
    still = betas.new_zeros(1, body.n_joints, 3)
    rest = body(still, betas, still[:, 0]).rest_joints[0].detach()
    return Skeleton(body.joint_names, body.parents, rest, "T of SMPL" if _is_smpl(body.joint_names) else body.name)


def convert_body_pose(
    source: BodyModel,
    target: BodyModel,
    pose: Tensor,
    transl: Tensor,
    source_betas: Tensor | None = None,
    target_betas: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Poses of one body -> poses of another: the packaged body, SMPL, SMPL+H and SMPL-X, any to any.

    World rotations carry over (a turn of the whole body exactly), rest bones of arms and legs are aligned (A-pose
    against T-pose), and the roots stand at the same place. Joints without a partner rest: twist bones, palms, toes past
    the first, all of SMPL's fingers.

    Args:
        source: the body that the poses belong to.
        target: the body wanted.
        pose: [T,J,3] axis-angle.
        transl: [T,3] metres.
        source_betas: [S] shape, an average adult by default.
        target_betas: [S'] likewise.

    Returns:
        pose [T,J',3] axis-angle and transl [T,3] metres.
    """
    here, there = body_skeleton(source, source_betas), body_skeleton(target, target_betas)
    rest = here.rest_joints[0].to(transl)
    posed = SkeletonPose(axis_angle_to_matrix(pose), transl + rest)
    converted = convert_pose(here, there, posed, joint_map(target.joint_names, source.joint_names), is_limb)
    return matrix_to_axis_angle(converted.rotations), converted.root - there.rest_joints[0].to(transl)


def joint_map(target_names: tuple[str, ...], source_names: tuple[str, ...]) -> dict[str, str] | None:
    """Target joint -> source joint between the bodies we know; None (equal names) for two of the same family."""
    to_smpl, from_smpl = _is_smpl(target_names), _is_smpl(source_names)
    if to_smpl and from_smpl:
        return within_smpl(target_names, source_names)
    if to_smpl:
        return smpl_from_packaged(target_names)
    return packaged_from_smpl(source_names) if from_smpl else None


def _is_smpl(joint_names: tuple[str, ...]) -> bool:
    return joint_names[0] == JOINT_NAMES["smpl"][0]


def rig_skeleton(body: PackagedBody) -> Skeleton:
    """The full rig of 163 bones that the body's joints are chosen from, which captures are stored in.

    The rest pose is the body's, so nothing is aligned; bones that are no joints of the body are placed at their nearest
    ancestor that is one.
    """
    joints = body_skeleton(body)
    placed: list[Tensor] = []
    for name, parent in zip(body.rig_names, body.rig_parents, strict=True):
        known = name in joints.joint_names
        placed.append(joints.rest_joints[joints.joint_names.index(name)] if known else placed[parent])
    return Skeleton(body.rig_names, body.rig_parents, torch.stack(placed), joints.rest_pose)


def from_local_ref(body: PackagedBody, pose_local_ref: Tensor, betas: Tensor) -> tuple[Tensor, Tensor]:
    """Captures' poses -> poses of the packaged body.

    Anny's "local-ref" pose parameters are rotations relative to the parent, in the axes of rest space: this body's own
    convention. Their root's translation is the root joint's position in the world.

    Args:
        body: the packaged body.
        pose_local_ref: [T,163,4,4], rigid; only the root may be translated.
        betas: [S] the subject's phenotype.

    Returns:
        pose [T,J,3] axis-angle and transl [T,3] metres.

    Raises:
        ValueError: for another shape, or translated bones, which no joint angle can express.
    """
    bones = len(body.rig_names)
    if pose_local_ref.ndim != 4 or pose_local_ref.shape[1:] != (bones, 4, 4):
        raise ValueError(f"expected pose_local_ref [T,{bones},4,4], got {tuple(pose_local_ref.shape)}")
    if float(pose_local_ref[:, 1:, :3, 3].abs().max()) > 1e-6:
        raise ValueError("expected bones that only rotate, got translated ones below the root; set them to zero")
    rotations = nearest_rotation(pose_local_ref[..., :3, :3])
    source = SkeletonPose(rotations, pose_local_ref[:, 0, :3, 3])
    target = body_skeleton(body, betas)
    converted = convert_pose(rig_skeleton(body), target, source)
    return matrix_to_axis_angle(converted.rotations), converted.root - target.rest_joints[0].to(converted.root)


def to_local_ref(body: PackagedBody, pose: Tensor, transl: Tensor, betas: Tensor) -> Tensor:
    """Poses of the packaged body -> Anny's "local-ref" pose parameters [T,163,4,4] of the full rig.

    Args:
        body: the packaged body.
        pose: [T,J,3] axis-angle.
        transl: [T,3] metres.
        betas: [S] the subject's phenotype.
    """
    own = body_skeleton(body, betas)
    posed = SkeletonPose(axis_angle_to_matrix(pose), transl + own.rest_joints[0])
    converted = convert_pose(own, rig_skeleton(body), posed)
    full = torch.eye(4, dtype=pose.dtype, device=pose.device).repeat(*converted.rotations.shape[:2], 1, 1)
    full[..., :3, :3] = converted.rotations
    full[:, 0, :3, 3] = converted.root
    return full


def skeleton_joints(skeleton: Skeleton, pose: SkeletonPose) -> Tensor:
    """Joint positions [T,J,3] of a posed skeleton, world, metres."""
    rest = skeleton.rest_joints[None].to(pose.rotations)
    transforms = forward_kinematics(pose.rotations, rest, skeleton.parents, pose.root - rest[:, 0])
    return (transforms[..., :3, :3] @ rest[..., None])[..., 0] + transforms[..., :3, 3]
