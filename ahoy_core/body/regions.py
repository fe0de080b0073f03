"""Regions of the body's surface, by vertex and by triangle."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor


def vertex_regions(faces: Tensor, face_regions: Mapping[str, Tensor], n_vertices: int) -> dict[str, Tensor]:
    """Bool masks [V] from bool masks [F].

    A vertex belongs to a region when one of its triangles does, except for "interior", where all of them must: the rim
    of the lips and of the eyelids is skin.

    Args:
        faces: [F,3] int64.
        face_regions: bool [F] each.
        n_vertices: V.
    """
    regions = {}
    for name, mask in face_regions.items():
        inside = torch.zeros(n_vertices, dtype=torch.bool, device=faces.device)
        inside[faces[mask].flatten()] = True
        if name == "interior":
            inside[faces[~mask].flatten()] = False
        regions[name] = inside
    return regions


def faces_within(faces: Tensor, vertex_mask: Tensor) -> Tensor:
    """Bool [F]: triangles with all three corners inside a vertex mask [V]."""
    return vertex_mask[faces].all(1)
