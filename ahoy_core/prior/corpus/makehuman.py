"""Reads MakeHuman's garments: `.mhclo` (how it hangs on the body), `.obj` (faces, UVs), `.mhmat` (textures)."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

_AXES = ("x", "y", "z")


class AssetError(ValueError):
    """A garment's file cannot be used. The text says what was expected, what was found, and what to do."""


@dataclass(frozen=True, eq=False)
class Garment:
    """A garment as its files describe it, not yet fitted to a body.

    Attributes:
        name: its folder's name.
        corners: [V,3] int64 vertices of the base mesh hm08 that each vertex hangs on.
        weights: [V,3] their weights, which add up to 1 and may be negative.
        offsets: [V,3] decimetres, MakeHuman's axes (y up, facing +z).
        scales: per axis the two vertices of hm08 and their distance (decimetres) on the body the garment was made on,
            or None where offsets do not grow with the body.
        covered: int64 base-mesh vertices that the garment hides.
        faces: [F,3] int32 into the garment's vertices.
        uvs: [F,3,2] float32, origin at the lower left.
        diffuse: the colour texture, or None.
        occlusion: the ambient-occlusion texture, or None.
    """

    name: str
    corners: Array
    weights: Array
    offsets: Array
    scales: tuple[tuple[int, int, float] | None, ...]
    covered: Array
    faces: Array
    uvs: Array
    diffuse: Path | None
    occlusion: Path | None


def read_garment(folder: Path) -> Garment:
    """Reads the garment in a folder of MakeHuman's assets.

    Raises:
        AssetError: when the folder lacks a `.mhclo`, or a file is not what it should be.
    """
    descriptions = sorted(folder.glob("*.mhclo"))
    if not descriptions:
        raise AssetError(f"expected a .mhclo file in {str(folder)!r}, got none; give MakeHuman's asset folder")
    fields = _read_mhclo(descriptions[0])
    faces, uvs = _read_obj(folder / fields["obj_file"])
    textures = _read_mhmat(folder / fields["material"]) if "material" in fields else {}
    rows = np.array(fields["verts"], dtype=np.float64)
    if len(rows) == 0 or faces.max() >= len(rows):
        raise AssetError(
            f"expected a line under 'verts' for each vertex of {fields['obj_file']}, got {len(rows)} lines"
        )
    return Garment(
        name=folder.name,
        corners=rows[:, :3].astype(np.int64),
        weights=rows[:, 3:6],
        offsets=rows[:, 6:9],
        scales=tuple(fields["scales"].get(axis) for axis in _AXES),
        covered=np.array(sorted(fields["delete"]), dtype=np.int64),
        faces=faces,
        uvs=uvs,
        diffuse=textures.get("diffuseTexture"),
        occlusion=textures.get("aomapTexture"),
    )


def _read_mhclo(path: Path) -> dict[str, Any]:
    fields: dict[str, Any] = {"scales": {}, "verts": [], "delete": set()}
    block = ""
    for line in path.read_text(errors="ignore").splitlines():
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if re.fullmatch(r"-?\d+", words[0]):
            if block == "verts":
                fields["verts"].append(_vertex_row(words))
            elif block == "delete_verts":
                fields["delete"].update(_ranges(line))
            continue
        key = words[0]
        if key in ("verts", "delete_verts"):
            block = key
        elif key[1:] == "_scale" and key[0] in _AXES:
            fields["scales"][key[0]] = (int(words[1]), int(words[2]), float(words[3]))
        elif key in ("obj_file", "material", "basemesh"):
            fields[key] = words[1]
    if fields.get("basemesh") != "hm08" or "obj_file" not in fields:
        raise AssetError(f"expected a garment on base mesh hm08 with an obj_file, got {path.name!r}; leave it out")
    return fields


def _vertex_row(words: list[str]) -> list[float]:
    if len(words) == 1:
        return [float(words[0])] * 3 + [1.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    return [float(word) for word in words[:9]]


def _ranges(line: str) -> set[int]:
    """Numbers of a line like `3 5 - 8 12`."""
    found: set[int] = set()
    for first, last in re.findall(r"(\d+)(?:\s*-\s*(\d+))?", line):
        found.update(range(int(first), int(last or first) + 1))
    return found


def _read_obj(path: Path) -> tuple[Array, Array]:
    """Triangles [F,3] and their texture coordinates [F,3,2]; polygons are cut into fans."""
    texture: list[list[float]] = []
    faces: list[tuple[int, int, int]] = []
    corners: list[tuple[int, int, int]] = []
    for line in path.read_text(errors="ignore").splitlines():
        words = line.split()
        if not words:
            continue
        if words[0] == "vt":
            texture.append([float(words[1]), float(words[2])])
        elif words[0] == "f":
            pairs = [[*word.split("/"), ""][:2] for word in words[1:]]
            vertex = [int(pair[0]) - 1 for pair in pairs]
            coordinate = [int(pair[1]) - 1 if pair[1] else 0 for pair in pairs]
            for k in range(1, len(vertex) - 1):
                faces.append((vertex[0], vertex[k], vertex[k + 1]))
                corners.append((coordinate[0], coordinate[k], coordinate[k + 1]))
    if not faces:
        raise AssetError(f"expected faces in {path.name!r}, got none; the file may be cut short")
    table = np.array(texture or [[0.0, 0.0]], dtype=np.float32)
    return np.array(faces, dtype=np.int32), table[np.array(corners)]


def _read_mhmat(path: Path) -> dict[str, Path]:
    """The textures that a material names and that exist."""
    found = {}
    for line in path.read_text(errors="ignore").splitlines() if path.is_file() else []:
        words = line.split()
        if len(words) == 2 and words[0].endswith("Texture") and (path.parent / words[1]).is_file():
            found[words[0]] = path.parent / words[1]
    return found
