"""Role "pose" by NLF (Sárándi and Pons-Moll, NeurIPS 2024), the released TorchScript files.

`detect_smpl_batched` finds everybody and returns lists, one entry an image: parameters (`trans` in metres), joints in
millimetres, and the model's own uncertainties in millimetres.
"""

from __future__ import annotations

from typing import Any, Final, Literal

import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor

from ahoy_core.models.adapter import Adapter, Fill
from ahoy_core.models.boxes import subject_among
from ahoy_core.models.checkpoint import device_of
from ahoy_core.models.contracts import PoseEstimate
from ahoy_core.models.torchscript import load_script

JOINTS: Final = {"smpl": 24, "smplx": 55}
BETAS: Final = 10
_MM: Final = 1e-3


class NlfOptions(BaseModel):
    """Knobs.

    Attributes:
        family: whose parameters: "smplx" where the body is SMPL-X, else "smpl".
        batch: frames at a time; halved where memory runs out.
        crops: people at a time inside the model (its `internal_batch_size`).
        augmentations: turned, scaled and mirrored looks that are averaged (its `num_aug`).
        min_overlap: share by which a found person's box must meet the subject's.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    family: Literal["smpl", "smplx"] = "smpl"
    batch: int = Field(default=8, ge=1)
    crops: int = Field(default=64, ge=1)
    augmentations: int = Field(default=1, ge=1)
    min_overlap: float = Field(default=0.2, ge=0, le=1)


class Nlf:
    """NLF as the role "pose".

    Args:
        model: the TorchScript module.
        device: where it is.
        options: the knobs.
    """

    name = "NLF"

    def __init__(self, model: Any, device: torch.device, options: NlfOptions) -> None:
        self.model, self.device, self.options = model, device, options

    @torch.no_grad()
    def __call__(self, frames: Tensor, K: Tensor, boxes: Tensor) -> PoseEstimate:
        """Parameters of the subject.

        Args:
            frames: [T,3,H,W] in [0,1].
            K: [3,3] pixels.
            boxes: [T,4] x0 y0 x1 y1 of the subject, pixels; NaN where it is not.
        """
        joints = JOINTS[self.options.family]
        count = len(frames)
        made = PoseEstimate(
            family=self.options.family,
            pose=torch.zeros(count, joints, 3),
            betas=torch.zeros(count, BETAS),
            joints=torch.zeros(count, joints, 3),
            uncertainty=torch.zeros(count, joints),
            found=torch.zeros(count, dtype=torch.bool),
        )
        rows = torch.nonzero(torch.isfinite(boxes).all(1)).flatten().tolist()
        size, start = self.options.batch, 0
        while start < len(rows):
            numbers = rows[start : start + size]
            try:
                self._read(frames, K, boxes, numbers, made)
                start += size
            except torch.OutOfMemoryError:
                if size == 1:
                    raise
                torch.cuda.empty_cache()
                size = max(1, size // 2)
        return made

    def _read(self, frames: Tensor, K: Tensor, boxes: Tensor, numbers: list[int], into: PoseEstimate) -> None:
        images = (255 * frames[numbers].clamp(0, 1)).round().to(torch.uint8).to(self.device)
        found = self.model.detect_smpl_batched(
            images,
            intrinsic_matrix=K.float()[None].to(self.device),
            internal_batch_size=self.options.crops,
            num_aug=self.options.augmentations,
            model_name=self.options.family,
        )
        for row, number in enumerate(numbers):
            detected = found["boxes"][row].float().cpu()
            corners = torch.cat([detected[:, :2], detected[:, :2] + detected[:, 2:4]], 1)
            who = subject_among(corners, boxes[number], self.options.min_overlap)
            if who is None:
                continue
            into.pose[number] = found["pose"][row][who].float().cpu().view(-1, 3)
            into.betas[number] = found["betas"][row][who].float().cpu()[:BETAS]
            into.joints[number] = _MM * found["joints3d"][row][who].float().cpu()
            into.uncertainty[number] = _MM * found["joint_uncertainties"][row][who].float().cpu()
            into.found[number] = True


def load_nlf(fill: Fill, adapter: Adapter) -> Nlf:
    """Read NLF's TorchScript file.

    Args:
        fill: `path` is the file, `trust_code` is set; `options`: `NlfOptions`.
        adapter: its declaration.

    Raises:
        CheckpointError: it is no TorchScript, or has no `detect_smpl_batched`.
    """
    model = load_script(fill, adapter, ("detect_smpl_batched",))
    return Nlf(model, device_of(fill), NlfOptions(**fill.options))
