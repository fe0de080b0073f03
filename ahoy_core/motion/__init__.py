"""Motions: poses over time that drive an avatar."""

from ahoy_core.motion.files import BUILT_IN, load_motion, save_motion
from ahoy_core.motion.motion import Motion, placed
from ahoy_core.motion.pca import fit_pose_pca, project_pose, projected_motion
from ahoy_core.motion.procedural import replay, turn, wave
from ahoy_core.motion.walk import sit, walk

__all__ = [
    "BUILT_IN",
    "Motion",
    "fit_pose_pca",
    "load_motion",
    "placed",
    "project_pose",
    "projected_motion",
    "replay",
    "save_motion",
    "sit",
    "turn",
    "walk",
    "wave",
]
