"""Synthetic files of the licensed bodies' true layout: key names, dtypes and sizes are theirs, every number is ours.

The person is made of tubes round a T-posing skeleton (y up, facing +z), so that regions, landmarks and poses mean
something; blend shapes are smooth waves.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np

from ahoy_core.body.smpl_names import JOINT_NAMES

# Vertices and triangles of the real files, closed pieces, and triangles missing from them.
SIZES = {"smpl": (6890, 13776, 1, 0), "smplh": (6890, 13776, 1, 0), "smplx": (10475, 20908, 10, 2)}
SHAPES = {"smpl": 10, "smplh": 16, "smplx": 400}
TEXTURE_COORDINATES = 11313  # SMPL-X's
_LEFT = {
    "hip": (0.07, -0.09, 0.0), "knee": (0.1, -0.47, 0.0), "ankle": (0.1, -0.87, -0.03), "foot": (0.12, -0.93, 0.09),
    "collar": (0.05, 0.4, -0.02), "shoulder": (0.17, 0.43, -0.02), "elbow": (0.43, 0.42, -0.04),
    "wrist": (0.68, 0.42, -0.03), "hand": (0.76, 0.42, -0.02), "eye_smplhf": (0.032, 0.66, 0.06),
}  # fmt: skip
_MIDDLE = {
    "pelvis": (0, 0, 0), "spine1": (0, 0.11, -0.02), "spine2": (0, 0.24, -0.01), "spine3": (0, 0.3, 0.01),
    "neck": (0, 0.5, -0.03), "head": (0, 0.58, 0.01), "jaw": (0, 0.58, 0.03),
}  # fmt: skip
_FINGER_Z = {"index": 0.03, "middle": 0.01, "ring": -0.01, "pinky": -0.03, "thumb": 0.05}
# Tubes: way points and radius. Ends are closed.
_TUBES = {
    "trunk": (((0, -0.1, 0), (0, 0.25, 0), (0, 0.52, -0.02)), 0.13),
    "head": (((0, 0.54, 0.01), (0, 0.78, 0.01)), 0.085),
    "left_arm": (((0.12, 0.43, -0.02), (0.43, 0.42, -0.04), (0.68, 0.42, -0.03), (0.86, 0.42, -0.01)), 0.045),
    "left_leg": (((0.09, -0.1, 0), (0.1, -0.47, 0), (0.1, -0.9, -0.02), (0.12, -0.94, 0.16)), 0.06),
}  # fmt: skip
_EYES = {"left_eye": (((0.032, 0.649, 0.06), (0.032, 0.671, 0.06)), 0.012)}
_THUMBS = {"left_thumb": (((0.7, 0.42, 0.03), (0.75, 0.42, 0.08)), 0.015)}


def rest_joints(kind: str) -> np.ndarray:
    """[J,3] in the file's axes."""
    joints = []
    for name in JOINT_NAMES[kind]:
        side, _, part = name.partition("_")
        if name in _MIDDLE:
            joints.append(_MIDDLE[name])
            continue
        sign = 1 if side == "left" else -1
        if part in _LEFT:
            x, y, z = _LEFT[part]
        else:
            finger, number = part[:-1], int(part[-1])
            start = 0.7 if finger == "thumb" else 0.76
            x, y, z = start + 0.03 * (number - 1), 0.42, _FINGER_Z[finger]
        joints.append((sign * x, y, z))
    return np.array(joints, dtype=np.float64)


def parents(kind: str) -> list[int]:
    names = JOINT_NAMES[kind]
    above = {
        "spine1": "pelvis",
        "spine2": "spine1",
        "spine3": "spine2",
        "neck": "spine3",
        "head": "neck",
        "jaw": "head",
    }
    sided = {"hip": "pelvis", "knee": "hip", "ankle": "knee", "foot": "ankle", "collar": "spine3", "shoulder": "collar",
             "elbow": "shoulder", "wrist": "elbow", "hand": "wrist", "eye_smplhf": "head"}  # fmt: skip
    found = [-1]
    for name in names[1:]:
        side, _, part = name.partition("_")
        if name in above:
            found.append(names.index(above[name]))
            continue
        parent = sided.get(part) or ("wrist" if part.endswith("1") else f"{part[:-1]}{int(part[-1]) - 1}")
        found.append(names.index(parent if parent in names else f"{side}_{parent}"))
    return found


def _tube(way: np.ndarray, radius: float, rings: int, around: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices, triangles (outwards) and texture coordinates of a closed tube."""
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1))])
    at = np.linspace(0, length[-1], rings)
    centre = np.stack([np.interp(at, length, way[:, i]) for i in range(3)], axis=1)
    along = np.gradient(centre, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    side = np.cross(along, [0.3, 0.2, 0.93])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(along, side)
    angle = np.linspace(0, 2 * np.pi, around, endpoint=False)
    thick = radius * np.sin(np.pi * (0.12 + 0.76 * np.arange(rings) / (rings - 1)))
    ring = np.cos(angle)[None, :, None] * side[:, None] + np.sin(angle)[None, :, None] * up[:, None]
    vertices = (centre[:, None] + thick[:, None, None] * ring).reshape(-1, 3)
    tips = np.stack([centre[0] - 0.3 * radius * along[0], centre[-1] + 0.3 * radius * along[-1]])
    i, j = np.mgrid[0 : rings - 1, 0:around]
    a, b = i * around + j, i * around + (j + 1) % around
    c, d = a + around, b + around
    j = np.arange(around)
    k, last = (j + 1) % around, (rings - 1) * around
    start, end = np.full(around, rings * around), np.full(around, rings * around + 1)
    faces = np.concatenate(
        [
            np.stack([a, b, c], -1).reshape(-1, 3), np.stack([b, d, c], -1).reshape(-1, 3),
            np.stack([start, k, j], -1), np.stack([end, last + j, last + k], -1),
        ]
    )  # fmt: skip
    uv = np.stack(np.meshgrid((np.arange(around) + 0.5) / around, np.linspace(0.03, 0.97, rings)), -1).reshape(-1, 2)
    return np.concatenate([vertices, tips]), faces, np.concatenate([uv, [[0.5, 0.0], [0.5, 1.0]]])


@cache
def _mesh(kind: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices [V,3], triangles [F,3] and texture coordinates [V,2], one tube a column of the unit square."""
    count, n_faces, pieces, missing = SIZES[kind]
    tubes = {**_TUBES, **(_EYES | _THUMBS if kind == "smplx" else {})}
    mirrored = {n.replace("left", "right"): (tuple((-x, y, z) for x, y, z in way), r) for n, (way, r) in tubes.items()
                if n.startswith("left")}  # fmt: skip
    tubes |= mirrored
    around = 36 if kind == "smplx" else 30
    rings = (count - 2 * len(tubes)) // (around * len(tubes)) - 1
    vertices, faces, uvs = [], [], []
    for column, (way, radius) in enumerate(tubes.values()):
        v, f, t = _tube(np.array(way, dtype=np.float64), radius, rings, around)
        faces.append(f + sum(map(len, vertices)))
        vertices.append(v)
        uvs.append((t * [0.9, 1] + [0.05, 0] + [column, 0]) / [len(tubes), 1])
    pieces_apart = len(tubes) - pieces
    bridges = [_bridge(faces, tube) for tube in range(pieces_apart)]
    v, f, t = np.concatenate(vertices), np.concatenate([*faces, *bridges]), np.concatenate(uvs)
    f = f[: len(f) - missing]
    v, f, t = _refine(v, f, t, count)
    assert (len(v), len(f)) == (count, n_faces), (len(v), len(f))
    return v, f, t


def _bridge(faces: list[np.ndarray], tube: int) -> np.ndarray:
    """Join two tubes into one piece: a triangle of each becomes a prism's two open ends."""
    (a, b, c), (d, e, f) = faces[tube][0], faces[tube + 1][7]
    faces[tube], faces[tube + 1] = faces[tube][1:], np.delete(faces[tube + 1], 7, axis=0)
    return np.array([[a, b, d], [b, f, d], [b, c, f], [c, e, f], [c, a, e], [a, d, e]])


def _refine(v: np.ndarray, f: np.ndarray, t: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Split triangles at their middle until there are `count` vertices."""
    extra = count - len(v)
    split = np.arange(len(f) // 4, len(f) // 4 + extra)
    middle = np.arange(len(v), count)
    a, b, c = f[split].T
    parts = [np.stack([a, b, middle], 1), np.stack([b, c, middle], 1), np.stack([c, a, middle], 1)]
    return (
        np.concatenate([v, v[f[split]].mean(axis=1)]),
        np.concatenate([np.delete(f, split, axis=0), *parts]),
        np.concatenate([t, t[f[split]].mean(axis=1)]),
    )


def _waves(points: np.ndarray, count: int, size: float, seed: int) -> np.ndarray:
    """Smooth vector fields [V,3,count]."""
    rng = np.random.default_rng(seed)
    frequency, phase = rng.normal(0, 3, (3, 3 * count)), rng.uniform(0, 6, 3 * count)
    return (size * np.sin(points @ frequency + phase)).reshape(len(points), 3, count)


@cache
def arrays(kind: str) -> dict[str, np.ndarray]:
    """What the file of a kind of body holds."""
    vertices, faces, uvs = _mesh(kind)
    joints, tree, count = rest_joints(kind), parents(kind), len(JOINT_NAMES[kind])
    whole = np.uint32 if kind == "smplx" else np.int64
    squared = ((vertices[:, None] - joints[None]) ** 2).sum(-1)
    weights = np.exp(-squared / 0.05**2) + 1e-12 * np.exp(-squared)
    # Each joint is the mean of the vertices round it, the more the nearer.
    regressor = np.exp(-squared / 0.04**2).T + 1e-9 * np.exp(-squared.T / 0.3**2)
    file = {
        "v_template": vertices,
        "f": faces.astype(np.uint32),
        "weights": weights / weights.sum(1, keepdims=True),
        "J_regressor": regressor / regressor.sum(1, keepdims=True),
        "kintree_table": np.array([[2**32 - 1, *tree[1:]], range(count)]).astype(whole),
        "shapedirs": _waves(vertices, SHAPES[kind], 0.004, 1),
        "posedirs": _waves(vertices, 9 * (count - 1), 0.001, 2),
    }  # fmt: skip
    if kind != "smpl":
        rng = np.random.default_rng(3)
        for side in "lr":
            file[f"hands_components{side}"] = np.linalg.qr(rng.normal(size=(45, 45)))[0]
            file[f"hands_mean{side}"] = rng.normal(0, 0.2, 45)
            file[f"hands_coeffs{side}"] = rng.normal(size=(1554, 45))
    return file | (_smplx_extras(vertices, faces, uvs) if kind == "smplx" else {"bs_type": np.array("lrotmin")})


def _smplx_extras(vertices: np.ndarray, faces: np.ndarray, uvs: np.ndarray) -> dict[str, np.ndarray]:
    """Landmarks (a few where a face has them), texture coordinates, and the two arrays that hold Python objects."""
    centres = vertices[faces].mean(axis=1)
    places = np.tile([0.0, 0.62, 0.1], (51, 1))
    x = {13: 0, 19: -0.046, 20: -0.03, 21: -0.03, 22: -0.017, 23: -0.03, 24: -0.03, 31: -0.026}
    for row, across in x.items():
        up = 0.62 if row == 13 else 0.582 if row == 31 else 0.66
        places[row] = across, up, 0.1
    for row, of in {25: 22, 26: 21, 27: 20, 28: 19, 29: 24, 30: 23, 37: 31}.items():
        places[row] = places[of] * [-1, 1, 1]
    skin = np.flatnonzero((np.abs(vertices[faces[:, 0], 0]) < 0.1) & (vertices[faces[:, 0], 1] > 0.54))
    nearest = ((centres[skin][None] - places[:, None]) ** 2).sum(-1).argmin(1)
    padded = np.concatenate([uvs, np.zeros((TEXTURE_COORDINATES - len(uvs), 2))])
    return {
        "lmk_faces_idx": skin[nearest].astype(np.int64),
        "lmk_bary_coords": np.full((51, 3), 1 / 3),
        "dynamic_lmk_faces_idx": np.zeros((79, 17), dtype=np.int64),
        "dynamic_lmk_bary_coords": np.full((79, 17, 3), 1 / 3),
        "vt": padded,
        "ft": faces.astype(np.uint32),
        "part2num": np.array({"pelvis": 0}, dtype=object),
        "joint2num": np.array({"pelvis": 0}, dtype=object),
    }


def write(folder: Path, kind: str, **changes: np.ndarray | None) -> Path:
    """Write a body file; `changes` replace arrays, None leaves one out."""
    path = folder / {"smpl": "SMPL_NEUTRAL.npz", "smplh": "model.npz", "smplx": "SMPLX_NEUTRAL.npz"}[kind]
    held = {**arrays(kind), **changes}
    np.savez(path, **{key: value for key, value in held.items() if value is not None})
    return path


FLAME_VERTICES = 5023


def write_flame(folder: Path, **changes: np.ndarray | None) -> Path:
    """FLAME's file in its true layout, and the list that says which of SMPL-X's vertices are FLAME's."""
    smplx = arrays("smplx")["v_template"]
    ids = np.argsort(-smplx[:, 1], kind="stable")[:FLAME_VERTICES]
    held = {
        "v_template": smplx[ids],
        "f": np.zeros((9976, 3), np.uint32),
        "weights": np.full((FLAME_VERTICES, 5), 0.2),
        "J_regressor": np.full((5, FLAME_VERTICES), 1 / FLAME_VERTICES),
        "kintree_table": np.array([[2**32 - 1, 0, 1, 1, 1], range(5)]).astype(np.uint32),
        "posedirs": np.zeros((FLAME_VERTICES, 3, 36)),
        "shapedirs": _waves(smplx[ids], 400, 0.003, 5),
    } | changes
    np.save(folder / "SMPL-X__FLAME_vertex_ids.npy", ids)
    path = folder / "FLAME_NEUTRAL.npz"
    np.savez(path, **{key: value for key, value in held.items() if value is not None})
    return path


def write_obj(path: Path, kind: str) -> Path:
    """A texture layout as a `.obj`, triangles in another order and turned round by one corner."""
    vertices, faces, uvs = _mesh(kind)
    lines = [f"v {x} {y} {z}" for x, y, z in vertices]
    lines += [f"vt {u:.6f} {v:.6f}" for u, v in uvs]
    lines += ["f " + " ".join(f"{k + 1}/{k + 1}" for k in np.roll(face, 1)) for face in faces[::-1]]
    path.write_text("\n".join(lines) + "\n")
    return path
