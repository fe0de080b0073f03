"""Regions and landmarks of an SMPL-family body, found on the user's own file: no vertex numbers are copied from it.

Regions follow the skin weights: a hand is what wrist and fingers move most. SMPL-X's face landmarks are in its file; on
the bodies without them, the face's landmarks are the nearest vertices to where an average face has them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final

import numpy as np
import torch
from torch import Tensor

from ahoy_core.body.keypoints import LANDMARK_NAMES
from ahoy_core.formats.smpl import SmplFile

MAX_VERTICES: Final = 16  # of one landmark, as on the packaged body
_HEAD: Final = ("head", "jaw", "left_eye_smplhf", "right_eye_smplhf")
_EYES: Final = ("left_eye_smplhf", "right_eye_smplhf")
# SMPL-X's 51 face landmarks are the 68 of iBUG without the 17 of the jaw line; right is the person's.
_FACE_51: Final[Mapping[str, tuple[int, ...]]] = {
    "nose": (13,),
    "right_eye_outer": (19,),
    "right_eye": (20, 21, 23, 24),
    "right_eye_inner": (22,),
    "left_eye_inner": (25,),
    "left_eye": (26, 27, 29, 30),
    "left_eye_outer": (28,),
    "mouth_right": (31,),
    "mouth_left": (37,),
}
# Where an average adult's face has them: to the left, and up from the tip of the nose, metres.
_FACE_OFFSETS: Final[Mapping[str, tuple[float, float]]] = {
    "eye_inner": (0.017, 0.038),
    "eye": (0.032, 0.039),
    "eye_outer": (0.046, 0.038),
    "mouth": (0.026, -0.038),
}
_LIMB_JOINTS: Final = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
# Knuckles: the joint that stands for them where there are fingers, else metres forward and outward of the hand joint.
_KNUCKLES: Final[Mapping[str, tuple[str, tuple[float, float]]]] = {
    "index": ("index1", (0.025, 0.0)),
    "pinky": ("pinky1", (-0.03, -0.01)),
    "thumb": ("thumb2", (0.05, -0.05)),
}


def find_regions(
    joint_names: tuple[str, ...], weights: Tensor, template: Tensor, joints: Tensor, head: np.ndarray | None
) -> dict[str, Tensor]:
    """Bool masks [V]: "head", "hands", "feet", "eyes" (the visible half of the eyeballs) and "interior" (the other).

    Args:
        joint_names: J names.
        weights: [V,J] skin weights.
        template: [V,3] rest vertices, our axes.
        joints: [J,3] rest joints.
        head: vertex numbers of the head, or None to tell by the weights.
    """
    owner = weights.argmax(1)

    def moved_by(wanted: Callable[[str], bool]) -> Tensor:
        return torch.isin(owner, torch.tensor([j for j, name in enumerate(joint_names) if wanted(name)]))

    fingers = ("index", "middle", "pinky", "ring", "thumb")
    eyes = moved_by(lambda name: name in _EYES)
    # The back half of an eyeball lies in the skull: behind the joint that turns it, which is its middle.
    hidden = eyes & (template[:, 1] > joints[owner, 1])
    if head is None:
        on_head = moved_by(lambda name: name in _HEAD)
    else:
        on_head = torch.zeros(len(template), dtype=torch.bool)
        on_head[torch.from_numpy(head)] = True
    return {
        "head": on_head,
        "hands": moved_by(lambda name: name.endswith(("_wrist", "_hand")) or name.partition("_")[2][:-1] in fingers),
        "feet": moved_by(lambda name: name.endswith(("_ankle", "_foot"))),
        "eyes": eyes & ~hidden,
        "interior": hidden,
    }


def find_landmarks(
    file: SmplFile,
    joint_names: tuple[str, ...],
    regressor: Tensor,
    template: Tensor,
    joints: Tensor,
    regions: Mapping[str, Tensor],
) -> tuple[Tensor, Tensor]:
    """The 33 BlazePose landmarks as convex blends: vertex numbers and weights, [33,MAX_VERTICES] each.

    Args:
        file: the body's file, for SMPL-X's face landmarks.
        joint_names: J names.
        regressor: [J,V] rows sum to 1.
        template: [V,3] rest vertices, our axes.
        joints: [J,3] rest joints.
        regions: as `find_regions` gives them.
    """
    finder = _Finder(template, joints, dict(zip(joint_names, range(len(joint_names)), strict=True)), regressor, regions)
    face = _file_face(file) if "lmk_faces_idx" in file.arrays and "lmk_bary_coords" in file.arrays else {}
    indices = torch.zeros(len(LANDMARK_NAMES), MAX_VERTICES, dtype=torch.int64)
    weights = torch.zeros(len(LANDMARK_NAMES), MAX_VERTICES, dtype=torch.float64)
    for row, name in enumerate(LANDMARK_NAMES):
        dense = face[name] if name in face else finder.dense(name)
        kept, vertices = dense.clamp(min=0).topk(min(MAX_VERTICES, len(dense)))
        indices[row, : len(vertices)] = torch.where(kept > 0, vertices, vertices[0])
        weights[row, : len(vertices)] = kept / kept.sum()
    return indices, weights


def _file_face(file: SmplFile) -> dict[str, Tensor]:
    """SMPL-X's own face landmarks, as dense rows [V]."""
    faces = torch.from_numpy(file.arrays["f"].astype(np.int64))
    corners = faces[torch.from_numpy(file.arrays["lmk_faces_idx"].astype(np.int64))]
    bary = torch.from_numpy(file.arrays["lmk_bary_coords"].astype(np.float64))
    found = {}
    for name, rows in _FACE_51.items():
        dense = torch.zeros(len(file.arrays["v_template"]), dtype=torch.float64)
        dense.index_add_(0, corners[list(rows)].flatten(), bary[list(rows)].flatten() / len(rows))
        found[name] = dense
    return found


class _Finder:
    """Landmarks told by joints and by the shape of the rest body."""

    def __init__(
        self,
        template: Tensor,
        joints: Tensor,
        index: Mapping[str, int],
        regressor: Tensor,
        regions: Mapping[str, Tensor],
    ) -> None:
        self.template, self.joints, self.index, self.regressor = template, joints, index, regressor
        self.head = regions["head"] & ~regions["eyes"] & ~regions["interior"]
        self.hands, self.feet = regions["hands"], regions["feet"]

    def dense(self, name: str) -> Tensor:
        """One landmark as weights [V] that sum to 1."""
        if name == "nose":
            return self._one(self._extreme(self.head, (0.0, -1.0, 0.0)))
        side, _, part = name.partition("_")
        if side == "mouth":
            side, part = part, "mouth"
        sign = 1.0 if side == "left" else -1.0
        if part in _LIMB_JOINTS:
            return self.regressor[self.index[f"{side}_{part}"]]
        if part == "ear":
            return self._one(self._extreme(self.head, (sign, 0.0, 0.0)))
        if part in ("heel", "foot_index"):
            # The shin's end moves with the ankle: a heel is low as well as far back.
            direction = (0.0, 1.0, -1.0) if part == "heel" else (0.0, -1.0, 0.0)
            return self._one(self._extreme(self._side(self.feet, sign), direction))
        if part in _KNUCKLES:
            return self._knuckle(side, sign, part)
        across, up = _FACE_OFFSETS[part]
        nose = self.template[self._extreme(self.head, (0.0, -1.0, 0.0))]
        point = torch.stack([nose[0] + sign * across, nose[1] + 0.03, nose[2] + up])
        return self._nearest(self.head, point)

    def _knuckle(self, side: str, sign: float, part: str) -> Tensor:
        joint, (forward, outward) = _KNUCKLES[part]
        if f"{side}_{joint}" in self.index:
            return self.regressor[self.index[f"{side}_{joint}"]]
        hand = self.joints[self.index[f"{side}_hand"]]
        return self._nearest(self._side(self.hands, sign), hand + hand.new_tensor([sign * outward, -forward, 0.0]))

    def _side(self, mask: Tensor, sign: float) -> Tensor:
        return mask & (sign * (self.template[:, 0] - self.joints[0, 0]) > 0)

    def _extreme(self, mask: Tensor, direction: tuple[float, float, float]) -> int:
        """The vertex of a region that lies furthest along a direction."""
        reach = self.template @ self.template.new_tensor(direction)
        return int(reach.masked_fill(~mask, -torch.inf).argmax())

    def _nearest(self, mask: Tensor, point: Tensor) -> Tensor:
        return self._one(int((self.template - point).norm(dim=1).masked_fill(~mask, torch.inf).argmin()))

    def _one(self, vertex: int) -> Tensor:
        dense = torch.zeros(len(self.template), dtype=torch.float64)
        dense[vertex] = 1
        return dense
