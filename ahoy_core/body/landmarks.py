"""Chooses the few vertices whose convex blend gives each BlazePose landmark; used once, by `compile`."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from scipy.optimize import nnls
from torch import Tensor

from ahoy_core.body.keypoints import LANDMARK_NAMES

MAX_VERTICES = 16  # of one landmark: keeps partial evaluation of the body cheap
_CANDIDATES = 48
# Landmarks that Anny's COCO regressor knows under the same name, and the one it names otherwise.
_COCO = {"left_foot_index": "left_big_toe", "right_foot_index": "right_big_toe"}
# First knuckles of little and index finger, second of the thumb (BlazePose's model card), as bone heads.
_KNUCKLES = {"pinky": "finger5-1", "index": "finger2-1", "thumb": "finger1-2"}


def fit_landmarks(model: Any, vertices: Tensor, heads: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Landmarks as convex blends of at most `MAX_VERTICES` vertices.

    Args:
        model: the library's model.
        vertices: [C,V,3] corner shapes at rest, on which the blends are fitted.
        heads: [C,163,3] their bone heads.

    Returns:
        Indices and weights, [33,MAX_VERTICES] each, padded with weight 0.
    """
    from anny.keypoints import KeypointsRegressor

    coco = KeypointsRegressor.coco(model)
    regression = dict(zip(coco.labels, coco.regression_weights, strict=True))
    indices = np.zeros((len(LANDMARK_NAMES), MAX_VERTICES), dtype=np.int64)
    weights = np.zeros((len(LANDMARK_NAMES), MAX_VERTICES))
    for row, name in enumerate(LANDMARK_NAMES):
        side, _, part = name.partition("_")
        if (rim := _rim_vertex(model, name)) is not None:
            indices[row, 0], weights[row, 0] = rim, 1.0
            continue
        if part in _KNUCKLES:
            bone = f"{_KNUCKLES[part]}.{'L' if side == 'left' else 'R'}"
            target = heads[:, model.bone_labels.index(bone)]
            candidates = (vertices - target[:, None]).norm(dim=-1).mean(0).argsort()[:_CANDIDATES]
        else:
            row_weights = regression[_COCO.get(name, name)]
            target = torch.einsum("v,cvd->cd", row_weights, vertices)
            candidates = row_weights.argsort(descending=True)[: max(_CANDIDATES, int((row_weights > 1e-4).sum()))]
            candidates = candidates[row_weights[candidates] > 0]
        indices[row], weights[row] = _convex_blend(vertices, target, candidates)
    return indices, weights


def _rim_vertex(model: Any, name: str) -> int | None:
    """Corners of mouth and eyes: the outermost vertices of the rim between skin and cavity."""
    if name.startswith("mouth_"):
        cavity, leftmost = "mouth_cavity", name.endswith("left")
    elif name.endswith(("_eye_inner", "_eye_outer")):
        left = name.startswith("left")
        cavity, leftmost = f"eye_cavity.{'L' if left else 'R'}", left == name.endswith("outer")
    else:
        return None
    from anny.face_segmentation import get_face_segmentation_mask

    inner = model.faces[get_face_segmentation_mask(model, [cavity])].unique()
    outer = model.faces[get_face_segmentation_mask(model, ["head"])].unique()
    rim = inner[torch.isin(inner, outer)]
    x = model.template_vertices[rim, 0]
    return int(rim[x.argmax() if leftmost else x.argmin()])


def _convex_blend(vertices: Tensor, target: Tensor, candidates: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Non-negative least squares for sum_k w_k v_k = target over all shapes, then again on the largest weights."""
    for limit in (len(candidates), MAX_VERTICES):
        candidates = candidates[:limit]
        columns = vertices[:, candidates].permute(0, 2, 1).reshape(-1, len(candidates)).numpy()
        # The heavy last row makes the weights sum to one.
        system = np.concatenate([columns, np.full((1, len(candidates)), 1e3)])
        solution, _ = nnls(system, np.append(target.flatten().numpy(), 1e3), maxiter=20 * len(candidates))
        order = np.argsort(-solution, kind="stable")
        candidates, solution = candidates[torch.from_numpy(order)], solution[order]
    indices, weights = np.zeros(MAX_VERTICES, dtype=np.int64), np.zeros(MAX_VERTICES)
    indices[: len(candidates)], weights[: len(candidates)] = candidates.numpy(), solution / solution.sum()
    return np.where(weights > 0, indices, indices[0]), weights
