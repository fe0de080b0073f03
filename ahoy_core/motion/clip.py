"""A recorded clip, still on the skeleton it was recorded with, and its retargeting to the body in use."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from torch import Tensor

from ahoy_core.body.convert import Skeleton, SkeletonPose, body_skeleton, convert_pose
from ahoy_core.body.model import BodyModel
from ahoy_core.body.rotations import matrix_to_axis_angle
from ahoy_core.body.smpl_names import is_limb
from ahoy_core.motion.motion import Motion
from ahoy_core.motion.time import held_where_missing, resampled


@dataclass(frozen=True)
class Clip:
    """A recording of T frames.

    Attributes:
        name: Of the recording.
        skeleton: Whose rotations these are, at rest in our axes; its rest joints may have any scale.
        pose: T poses, root positions in the skeleton's own units.
        fps: Frames per second.
        hip_height: Of the root above the ground at rest, in the skeleton's units: what distances are scaled by.
        joints: Target joint -> source joint for the packaged body.
        notes: What was assumed or left out, one sentence each.
    """

    name: str
    skeleton: Skeleton
    pose: SkeletonPose
    fps: float
    hip_height: float
    joints: Mapping[str, str]
    notes: tuple[str, ...] = ()


def retarget(clip: Clip, body: BodyModel, betas: Tensor, fps: float) -> Motion:
    """The clip as a motion of the body, at another rate.

    Frames that are not finite are interpolated, distances are scaled by the height of the hips, and the clip is sampled
    by time, so that a recording at 1,000 frames a second plays at its own speed.

    Args:
        clip: The recording.
        body: The body in use.
        betas: [S] its shape.
        fps: Frames per second wanted.

    Raises:
        ValueError: If no frame is finite, or none of the clip's joints has a counterpart.
    """
    rotations, root, notes = held_where_missing(clip.pose.rotations, clip.pose.root)
    rotations, root = resampled(rotations, root, clip.fps, fps)
    target = body_skeleton(body, betas)
    joints = {t: s for t, s in clip.joints.items() if t in body.joint_names and s in clip.skeleton.joint_names}
    if len(joints) < 2:
        raise ValueError(
            f"expected joints of the body in {clip.name!r}, got {list(clip.skeleton.joint_names)[:8]}; rename its "
            "joints, or convert it to the names of SMPL or BVH's usual ones"
        )
    # Everybody's trunk stands upright at rest and everybody's soles are flat: only limbs are aligned.
    converted = convert_pose(clip.skeleton, target, SkeletonPose(rotations, root), joints, is_limb)
    scale = float(standing_hip_height(target)) / clip.hip_height
    transl = converted.root * scale - target.rest_joints[0].to(converted.root)
    pose = matrix_to_axis_angle(converted.rotations).float()
    silent = sorted(set(clip.joints.values()) - set(joints.values()))
    if silent:
        notes = (*notes, f"joints missing from the recording stay at rest: {', '.join(silent)}")
    return Motion(clip.name, pose, transl.float(), fps, notes=(*clip.notes, *notes))


def standing_hip_height(skeleton: Skeleton) -> Tensor:
    """Height of the root over the lowest joint at rest."""
    return skeleton.rest_joints[0, 2] - skeleton.rest_joints[:, 2].min()
