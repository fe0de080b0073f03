"""Boxes of people, and choosing the subject among the people that a model finds."""

from __future__ import annotations

import torch
from torch import Tensor


def box_overlap(a: Tensor, b: Tensor) -> Tensor:
    """Intersection over union of boxes [...,4] x0 y0 x1 y1; 0 where there is no area."""
    low, high = torch.maximum(a[..., :2], b[..., :2]), torch.minimum(a[..., 2:], b[..., 2:])
    shared = (high - low).clamp(min=0).prod(-1)
    areas = [(box[..., 2:] - box[..., :2]).clamp(min=0).prod(-1) for box in (a, b)]
    return shared / (areas[0] + areas[1] - shared).clamp(min=1e-6)


def mask_bounds(mask: Tensor) -> Tensor:
    """x0 y0 x1 y1 [4] of what is above half in a mask [H,W]; zeros where nothing is."""
    inside = mask > 0.5
    if not bool(inside.any()):
        return torch.zeros(4)
    rows, columns = torch.nonzero(inside.any(1)).flatten(), torch.nonzero(inside.any(0)).flatten()
    return torch.stack([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1]).float()


def subject_among(found: Tensor, box: Tensor, least: float) -> int | None:
    """The row of `found` [N,4] that overlaps the subject's box [4] best, None if none by `least` or more."""
    if len(found) == 0:
        return None
    overlap = box_overlap(found, box[None].to(found))
    best = int(overlap.argmax())
    return best if float(overlap[best]) >= least else None
