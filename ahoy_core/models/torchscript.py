"""Reading TorchScript: programs, so only what a user trusts by name gets here (`Adapter.require`)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ahoy_core.models.adapter import Adapter, Fill
from ahoy_core.models.checkpoint import device_of, short
from ahoy_core.models.errors import CheckpointError
from ahoy_core.models.hashes import sha256_of
from ahoy_core.models.shelf import network


def load_script(fill: Fill, adapter: Adapter, methods: Sequence[str] = ("forward",), file: Path | None = None) -> Any:
    """A TorchScript file on the device that was asked for, in evaluation mode.

    Args:
        fill: `path` is the file; `trust_code` has been checked.
        adapter: its declaration.
        methods: that it must have.
        file: instead of `fill.path`, where that is a folder.

    Raises:
        CheckpointError: it is truncated, no TorchScript, or another model's: missing methods are named.
    """
    path = file or fill.path
    assert path is not None
    define_nms()
    try:
        model = network(path, "TorchScript", device_of(fill), lambda: torch.jit.load(str(path), map_location="cpu"))
    except Exception as error:  # the reader raises RuntimeError, ValueError and others, by where the file breaks
        raise CheckpointError(
            f"{adapter.label}: {path} cannot be read as TorchScript ({short(error)}, {path.stat().st_size} bytes, "
            f"sha256 {sha256_of(path)[:12]}); it is truncated or no TorchScript: {adapter.how_to_get()}"
        ) from error
    missing = [name for name in methods if not hasattr(model, name)]
    if missing:
        raise CheckpointError(
            f"{adapter.label}: {path} is TorchScript without {', '.join(missing)}: another model's; "
            f"{adapter.how_to_get()}"
        )
    return model.eval()


@lru_cache(maxsize=1)
def define_nms() -> torch.library.Library | None:
    """Define the operator `torchvision::nms`, which detectors in TorchScript call, where torchvision has not.

    Returns:
        What keeps the definition alive.
    """
    if hasattr(torch.ops.torchvision, "nms"):
        return None
    library = torch.library.Library("torchvision", "FRAGMENT")
    library.define("nms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
    library.impl("nms", nms, "CPU")
    library.impl("nms", nms, "CUDA")
    return library


def nms(dets: Tensor, scores: Tensor, iou_threshold: float) -> Tensor:
    """Greedy non-maximum suppression, as torchvision defines it.

    Args:
        dets: [N,4] x0 y0 x1 y1.
        scores: [N].
        iou_threshold: boxes that overlap a better one by more are dropped.

    Returns:
        Indices [M] of the boxes kept, best first.
    """
    order = scores.argsort(descending=True, stable=True)
    boxes = dets[order]
    low = torch.maximum(boxes[:, None, :2], boxes[None, :, :2])
    high = torch.minimum(boxes[:, None, 2:], boxes[None, :, 2:])
    shared = (high - low).clamp(min=0).prod(-1)
    area = (boxes[:, 2:] - boxes[:, :2]).prod(-1)
    worse = (shared / (area[:, None] + area[None] - shared) > iou_threshold).triu(1).cpu()
    kept = torch.ones(len(boxes), dtype=torch.bool)
    for row in range(len(boxes)):
        if kept[row]:
            kept &= ~worse[row]
    return order[kept.to(order.device)]
