"""Role "surface" by DensePose (Güler et al., CVPR 2018), exported to TorchScript without detectron2.

The file takes one picture [H,W,3] uint8, blue first, and returns boxes, scores and per person 112 x 112 logits of 25
coarse to fine parts with a chart coordinate for each.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor
from torch.nn.functional import interpolate

from ahoy_core.formats.densepose import ChartTable, read_chart_table
from ahoy_core.formats.errors import BodyFileError
from ahoy_core.models.adapter import Adapter, Fill
from ahoy_core.models.boxes import subject_among
from ahoy_core.models.checkpoint import device_of
from ahoy_core.models.contracts import Charts
from ahoy_core.models.errors import CheckpointError
from ahoy_core.models.people_adapters import SMPL_FILES, TABLE_FILE
from ahoy_core.models.torchscript import load_script

PARTS: Final = (
    "background", "torso", "torso", "hand", "hand", "foot", "foot",
    *("leg",) * 8, *("arm",) * 8, "head", "head",
)  # fmt: skip
"""What each of DensePose's 25 labels shows."""
_OUTPUTS: Final = (
    "pred_boxes", "pred_densepose_coarse_segm", "pred_densepose_fine_segm", "pred_densepose_u", "pred_densepose_v",
)  # fmt: skip


class DensePoseOptions(BaseModel):
    """Knobs.

    Attributes:
        min_overlap: share by which a found person's box must meet the subject's.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    min_overlap: float = Field(default=0.2, ge=0, le=1)


class DensePose:
    """DensePose as the role "surface".

    Args:
        model: the TorchScript module.
        device: where it is.
        options: the knobs.
        label: of the adapter, for messages.
        table: its charts on SMPL's vertices, where the user has the table.
        smpl: SMPL's file, which says where these vertices are.
    """

    name = "DensePose"

    def __init__(
        self,
        model: Any,
        device: torch.device,
        options: DensePoseOptions,
        label: str,
        table: ChartTable | None = None,
        smpl: Path | None = None,
    ) -> None:
        self.model, self.device, self.options, self._label = model, device, options, label
        self.table, self.smpl = table, smpl

    @torch.no_grad()
    def __call__(self, frames: Tensor, boxes: Tensor) -> Charts:
        """Part and chart coordinates of the subject's pixels.

        Args:
            frames: [T,3,H,W] in [0,1].
            boxes: [T,4] x0 y0 x1 y1 of the subject, pixels; NaN where it is not.
        """
        count, _, height, width = frames.shape
        part = torch.zeros(count, height, width, dtype=torch.uint8)
        uv = torch.zeros(count, 2, height, width)
        for t in torch.nonzero(torch.isfinite(boxes).all(1)).flatten().tolist():
            bgr = (255 * frames[t].clamp(0, 1)).round().to(torch.uint8).flip(0).permute(1, 2, 0).contiguous()
            found = self._checked(self.model(bgr.to(self.device)))
            who = subject_among(found["pred_boxes"], boxes[t], self.options.min_overlap)
            if who is not None:
                paste(part[t], uv[t], *(found[name][who] for name in _OUTPUTS))
        return Charts(part, uv)

    def _checked(self, found: Any) -> dict[str, Tensor]:
        missing = [name for name in _OUTPUTS if name not in found]
        if missing:
            raise CheckpointError(f"{self._label}: the model's answer lacks {', '.join(missing)}: export it anew")
        return {name: found[name].float().cpu() for name in _OUTPUTS}


def paste(part: Tensor, uv: Tensor, box: Tensor, coarse: Tensor, fine: Tensor, u: Tensor, v: Tensor) -> None:
    """Write one person's charts into a frame, as DensePose's own tools do.

    Args:
        part: [H,W] uint8, changed.
        uv: [2,H,W], changed.
        box: [4] x0 y0 x1 y1, pixels.
        coarse: [2 or 15,h,w] logits, 0 is background.
        fine: [25,h,w] logits.
        u: [25,h,w] one chart coordinate a part.
        v: [25,h,w].
    """
    x0, y0 = int(box[0]), int(box[1])
    size = max(int(box[3] - box[1]), 1), max(int(box[2] - box[0]), 1)
    coarse, fine, u, v = (_resized(x, size) for x in (coarse, fine, u, v))
    label = fine.argmax(0) * (coarse.argmax(0) > 0)
    inside = slice(max(0, y0), y0 + size[0]), slice(max(0, x0), x0 + size[1])
    target = part[inside]
    cut = slice(max(0, -y0), max(0, -y0) + target.shape[0]), slice(max(0, -x0), max(0, -x0) + target.shape[1])
    label = label[cut]
    target[:] = label.to(torch.uint8)
    for row, chart in enumerate((u, v)):
        uv[row][inside] = chart[(slice(None), *cut)].gather(0, label[None])[0].clamp(0, 1) * (label > 0)


def _resized(x: Tensor, size: tuple[int, int]) -> Tensor:
    return interpolate(x[None], size, mode="bilinear", align_corners=False)[0]


def load_densepose(fill: Fill, adapter: Adapter) -> DensePose:
    """Read a DensePose export.

    Args:
        fill: `path` is the TorchScript file, `trust_code` is set; `options`: `DensePoseOptions`.
        adapter: its declaration.

    Raises:
        CheckpointError: it is no TorchScript, or the table beside it is none.
    """
    beside = {path.name: path for path in adapter.companions(fill)}
    try:
        table = read_chart_table(beside[TABLE_FILE]) if TABLE_FILE in beside else None
    except BodyFileError as error:
        raise CheckpointError(f"{adapter.label}: {error}") from error
    smpl = next((beside[name] for name in SMPL_FILES if name in beside), None)
    model = load_script(fill, adapter)
    device = device_of(fill)
    model = model.float() if device.type == "cpu" else model  # exports in half precision don't run on a CPU
    return DensePose(model, device, DensePoseOptions(**fill.options), adapter.label, table, smpl)
