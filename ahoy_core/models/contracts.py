"""What models say to the rest of the system: the values that adapters return, and the protocols of the roles.

Contracts: float32, RGB in [0,1], metres, OpenCV cameras. An empty input gives an empty result, a single frame is a
clip.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

from torch import Tensor

from ahoy_core.conventions import Cameras


@dataclass(frozen=True)
class PoseEstimate:
    """SMPL-family parameters of one person in T frames, in the file's own axes, posed in the camera's.

    Attributes:
        family: whose joints these are.
        pose: [T,J,3] axis-angle, radians; joint 0 turns the body from the file's axes (y up) to the camera's (y down).
        betas: [T,S].
        joints: [T,J,3] metres, camera.
        uncertainty: [T,J] metres, the model's own estimate of its error.
        found: [T] bool, a person was found where one was looked for; rows of other frames are zero.
    """

    family: Literal["smpl", "smplx"]
    pose: Tensor
    betas: Tensor
    joints: Tensor
    uncertainty: Tensor
    found: Tensor


@dataclass(frozen=True)
class Charts:
    """DensePose's answer for T frames.

    Attributes:
        part: [T,H,W] uint8, 0 background, 1 to 24 (`ahoy_core.models.densepose.PARTS`).
        uv: [T,2,H,W] in [0,1] within the part's chart; 0 where there is no part.
    """

    part: Tensor
    uv: Tensor


class Pose(Protocol):
    """Role "pose" (the paper: NLF)."""

    def __call__(self, frames: Tensor, K: Tensor, boxes: Tensor) -> PoseEstimate:
        """Frames [T,3,H,W], K [3,3], boxes [T,4] x0 y0 x1 y1 of the subject (NaN: not there) -> parameters."""
        ...


class Mask(Protocol):
    """Role "mask" (the paper: SAM 3)."""

    def __call__(self, frames: Tensor, boxes: Tensor) -> Tensor:
        """Frames [T,3,H,W] of one shot, boxes [T,4] of the subject (NaN: not there) -> visible person [T,1,H,W]."""
        ...


class Head(Protocol):
    """Role "head" (the paper: Sapiens and SAM 3)."""

    def __call__(self, frames: Tensor, masks: Tensor) -> Tensor:
        """Frames [T,3,H,W], visible person [T,1,H,W] -> its head with hair [T,1,H,W], nowhere above the mask."""
        ...


class SurfaceParts(Protocol):
    """Role "surface" (the paper: DensePose)."""

    def __call__(self, frames: Tensor, boxes: Tensor) -> Charts:
        """Frames [T,3,H,W], boxes [T,4] of the subject (NaN: not there) -> part and chart coordinates."""
        ...


class Inpaint(Protocol):
    """Role "inpaint" (the paper: FLUX Fill)."""

    def __call__(self, image: Tensor, mask: Tensor, prompt: str = "", seed: int = 0) -> Tensor:
        """Image [3,H,W] and mask [1,H,W] (1 = fill) -> image [3,H,W]."""
        ...


class Views(Protocol):
    """Role "views" (the paper: SyncHuman)."""

    def __call__(self, image: Tensor, mask: Tensor) -> tuple[Tensor, tuple[float, ...]]:
        """Canonical image [3,H,W] and mask [1,H,W] -> views [4,3,H,W] and their azimuths in degrees."""
        ...


class Face(Protocol):
    """Role "face" (the paper: CAP4D)."""

    def __call__(self, references: Tensor, expressions: Tensor, cameras: Cameras, seed: int = 0) -> Tensor:
        """Pictures of the head [R,3,S,S], expressions [P,E], P cameras in the head's frame -> [P,3,S,S] over grey."""
        ...
