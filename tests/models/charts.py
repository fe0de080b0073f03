"""A table of charts in the true layout of DensePose's `UV_Processed.mat`, on the synthetic SMPL mesh of `licensed`."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
from scipy.io import savemat

from ahoy_core.body.smpl_names import JOINT_NAMES
from tests.body import licensed

# Chart by the joint that moves a triangle most: front (or inner) and back (or outer) half of each limb.
_CHARTS = {
    "torso": (1, 2), "right_hand": (3, 3), "left_hand": (4, 4), "left_foot": (5, 5), "right_foot": (6, 6),
    "right_thigh": (7, 9), "left_thigh": (8, 10), "right_calf": (11, 13), "left_calf": (12, 14),
    "left_arm": (15, 17), "right_arm": (16, 18), "left_forearm": (19, 21), "right_forearm": (20, 22), "head": (23, 24),
}  # fmt: skip
_OF_JOINT = {"hip": "thigh", "knee": "calf", "ankle": "foot", "foot": "foot", "collar": "arm", "shoulder": "arm",
             "elbow": "forearm", "wrist": "hand", "hand": "hand"}  # fmt: skip


@cache
def parts_of() -> np.ndarray:
    """Chart [F] of each triangle."""
    held, names = licensed.arrays("smpl"), JOINT_NAMES["smpl"]
    faces = held["f"].astype(int)
    middle = held["v_template"][faces].mean(1)
    owner = held["weights"][faces].sum(1).argmax(1)
    joints = licensed.rest_joints("smpl")
    charts = []
    for face, joint in enumerate(owner):
        side, _, part = names[joint].partition("_")
        word = f"{side}_{_OF_JOINT[part]}" if part in _OF_JOINT else ("head" if names[joint] == "head" else "torso")
        first, second = _CHARTS[word]
        if word == "head":
            charts.append(second if middle[face, 0] > 0 else first)
        else:
            charts.append(first if middle[face, 2] > joints[joint, 2] else second)
    return np.array(charts)


@cache
def table_arrays() -> dict[str, np.ndarray]:
    """What the file holds: MATLAB's shapes, numbers from 1, U and V by the two long directions of each chart."""
    held = licensed.arrays("smpl")
    faces, vertices, chart = held["f"].astype(int), held["v_template"], parts_of()
    ids, uv, new_faces = [], [], np.zeros_like(faces)
    count = 0
    for number in range(1, 25):
        own = np.flatnonzero(chart == number)
        used, local = np.unique(faces[own], return_inverse=True)
        points = vertices[used] - vertices[used].mean(0)
        axes = np.linalg.svd(points, full_matrices=False)[2][:2]
        flat = points @ axes.T
        uv.append((flat - flat.min(0)) / np.maximum(np.ptp(flat, axis=0), 1e-9))
        ids.append(used + 1)
        new_faces[own] = local.reshape(-1, 3) + count + 1
        count += len(used)
    u, v = np.concatenate(uv).T
    return {
        "All_vertices": np.concatenate(ids)[None].astype(np.float64),
        "All_U_norm": u[:, None],
        "All_V_norm": v[:, None],
        "All_Faces": new_faces.astype(np.float64),
        "All_FaceIndices": chart[:, None].astype(np.uint8),
    }


def write_table(folder: Path) -> Path:
    """Write `UV_Processed.mat` into a folder."""
    path = folder / "UV_Processed.mat"
    savemat(path, table_arrays())
    return path
