"""MakeHuman's garments: reading the files, and hanging one on a shaped body (format: the assets' README)."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class Garment:
    """One `.mhclo` with its mesh.

    Attributes:
        name: the folder's.
        anchors: [N,3] base-mesh vertices that each vertex hangs on.
        shares: [N,3] their weights, rows sum to 1, may be negative.
        offsets: [N,3] decimetres in MakeHuman's axes, before scaling.
        scales: for x, y, z: two base-mesh vertices and their distance on the author's body, or None.
        covers: base-mesh vertices under the garment.
        faces: [F,3].
        uvs: [F,3,2] of the corners.
        texture: its colour map, if there is one.
    """

    name: str
    anchors: IntArray
    shares: FloatArray
    offsets: FloatArray
    scales: tuple[tuple[int, int, float] | None, ...]
    covers: frozenset[int]
    faces: IntArray
    uvs: FloatArray
    texture: Path | None

    def hang(self, base: FloatArray) -> FloatArray:
        """Positions [N,3] on a base mesh [19158,3]; both in metres, z up."""
        mh = 10 * np.stack([base[:, 0], base[:, 2], -base[:, 1]], axis=1)
        offsets = self.offsets.copy()
        for axis, scale in enumerate(self.scales):
            if scale:
                offsets[:, axis] *= abs(mh[scale[0], axis] - mh[scale[1], axis]) / scale[2]
        points = np.einsum("nk,nkd->nd", self.shares, mh[self.anchors]) + offsets
        return np.stack([points[:, 0], -points[:, 2], points[:, 1]], axis=1) / 10

    def follow(self, moved: FloatArray) -> FloatArray:
        """Displacements [N,3] that follow those of the base mesh's vertices [19158,3]."""
        return np.asarray(np.einsum("nk,nkd->nd", self.shares, moved[self.anchors]))

    def weights(self, base: FloatArray) -> FloatArray:
        """Skinning weights [N,J] from the base mesh's [19158,J]."""
        shares = np.clip(self.shares, 0, None)
        mixed = np.einsum("nk,nkj->nj", shares / shares.sum(1, keepdims=True), base[self.anchors])
        return np.asarray(mixed / mixed.sum(1, keepdims=True))


@cache
def read_garment(path: Path) -> Garment:
    """Read a `.mhclo`, the mesh and the material it names."""
    fields: dict[str, str] = {}
    scales: dict[str, tuple[int, int, float]] = {}
    rows: list[list[float]] = []
    covers: set[int] = set()
    section = ""
    for line in path.read_text(encoding="utf-8", errors="ignore").splitlines():
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if words[0][0].isdigit() and section == "delete_verts":
            covers |= _ranges(line)
        elif words[0][0].isdigit():
            numbers = [float(word) for word in words]
            rows.append(numbers if len(numbers) > 1 else [numbers[0]] * 3 + [1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
        else:
            section = words[0]
            fields[section] = words[-1]
            if section in ("x_scale", "y_scale", "z_scale"):
                scales[section[0]] = (int(words[1]), int(words[2]), float(words[3]))
    table = np.array([row[:9] for row in rows])
    faces, uvs = _read_obj(path.parent / fields["obj_file"])
    return Garment(
        path.parent.name, table[:, :3].astype(np.int64), table[:, 3:6], table[:, 6:9],
        tuple(scales.get(axis) for axis in "xyz"), frozenset(covers), faces, uvs,
        _texture(path.parent / fields.get("material", "")),
    )  # fmt: skip


def _ranges(line: str) -> set[int]:
    """Numbers of `3 5 - 9 12`."""
    numbers: set[int] = set()
    for first, last in re.findall(r"(\d+)(?:\s*-\s*(\d+))?", line):
        numbers.update(range(int(first), int(last or first) + 1))
    return numbers


def _texture(material: Path) -> Path | None:
    if not material.is_file():
        return None
    found = re.search(r"^\s*diffuseTexture\s+(\S+)", material.read_text(encoding="utf-8", errors="ignore"), re.M)
    path = material.parent / found.group(1) if found else None
    return path if path is not None and path.is_file() else None


def _read_obj(path: Path) -> tuple[IntArray, FloatArray]:
    """Triangles [F,3] and their corners' texture coordinates [F,3,2]."""
    places: list[list[float]] = []
    faces: list[list[int]] = []
    corners: list[list[int]] = []
    for line in path.read_text(encoding="utf-8", errors="ignore").splitlines():
        words = line.split()
        if words[:1] == ["vt"]:
            places.append([float(words[1]), float(words[2])])
        elif words[:1] == ["f"]:
            ends = [[int(x or 1) - 1 for x in word.split("/")[:2]] + [0] for word in words[1:]]
            for k in range(1, len(ends) - 1):
                faces.append([ends[0][0], ends[k][0], ends[k + 1][0]])
                corners.append([ends[0][1], ends[k][1], ends[k + 1][1]])
    return np.array(faces, np.int64), np.array(places)[np.array(corners, np.int64)]
