"""The user's licensed body files: SMPL, SMPL+H and SMPL-X as `.npz`, and texture coordinates as `.obj`.

Nothing of these models ships with the package. Key names and shapes are those of the files that their makers hand out:
`v_template` [V,3], `shapedirs` [V,3,S], `posedirs` [V,3,9(J-1)], `J_regressor` [J,V], `kintree_table` [2,J], `weights`
[V,J], `f` [F,3]; SMPL+H and SMPL-X add the hands' PCA, SMPL-X its landmarks (`lmk_*`) and texture coordinates (`vt`,
`ft`). SMPL-X's `part2num` and `joint2num` are Python objects, which only a pickle can hold: they are never read.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ahoy_core.formats.errors import BodyFileError, NpzError
from ahoy_core.formats.npz import load_npz, npz_names

KIND_OF_JOINTS = {24: "smpl", 52: "smplh", 55: "smplx"}
REQUIRED = ("v_template", "shapedirs", "posedirs", "J_regressor", "kintree_table", "weights", "f")
HANDS = ("hands_meanl", "hands_meanr", "hands_componentsl", "hands_componentsr")
FLAME_JOINTS, FLAME_SHAPES = 5, 300
OPTIONAL = (*HANDS, "lmk_faces_idx", "lmk_bary_coords", "vt", "ft")
CONVERT = (
    "a pickle runs whatever is written in it, so it is never opened here: take the .npz that the body's makers offer, "
    "or convert the file once as docs/models.md shows"
)


@dataclass(frozen=True)
class SmplFile:
    """What a body file holds, as read: the file's own axes (y up, facing +z), metres.

    Attributes:
        kind: "smpl", "smplh" or "smplx", told by the number of joints.
        arrays: the required arrays, and those of the optional ones that the file has.
        parents: parent of each joint, -1 for the root.
    """

    kind: str
    arrays: Mapping[str, NDArray[np.generic]]
    parents: tuple[int, ...]


def read_smpl(path: str | Path) -> SmplFile:
    """Read a body file; nothing in it is executed.

    Raises:
        FileNotFoundError: no such file.
        BodyFileError: a pickle, no `.npz`, an array is missing, or sizes disagree; the text says what to do.
    """
    source = Path(path)
    if source.suffix.lower() in (".pkl", ".pickle"):
        raise BodyFileError(f"expected a .npz body file, got {source.name!r}: {CONVERT}")
    try:
        held = set(npz_names(source))
        missing = sorted(set(REQUIRED) - held)
        if missing:
            raise BodyFileError(
                f"expected the arrays {list(REQUIRED)} of SMPL, SMPL+H or SMPL-X in {source.name!r}, got none of "
                f"{missing}; give the model file itself, not a motion or a fit"
            )
        arrays = load_npz(source, [*REQUIRED, *(name for name in OPTIONAL if name in held)])
    except NpzError as error:
        raise BodyFileError(
            f"expected plain arrays in {source.name!r}, got: {error}; convert it as docs/models.md shows"
        ) from error
    kind = _check(source.name, arrays)
    return SmplFile(kind, arrays, _parents(source.name, arrays["kintree_table"]))


@dataclass(frozen=True)
class FlameFile:
    """What a FLAME file gives to a body: its expressions.

    Attributes:
        expressions: [V,3,E] metres, in the file's axes (those of SMPL-X), for FLAME's V vertices.
    """

    expressions: NDArray[np.generic]


def read_flame(path: str | Path) -> FlameFile:
    """Read FLAME's `.npz`: `v_template` [V,3], `weights` [V,5], `shapedirs` [V,3,300+E], of which E are expressions.

    Raises:
        FileNotFoundError: no such file.
        BodyFileError: a pickle, no `.npz`, or not FLAME; the text says what to do.
    """
    source = Path(path)
    if source.suffix.lower() in (".pkl", ".pickle"):
        raise BodyFileError(f"expected FLAME as .npz, got {source.name!r}: {CONVERT}")
    try:
        arrays = load_npz(source, ["v_template", "weights", "shapedirs"])
    except NpzError as error:
        raise BodyFileError(
            f"expected FLAME's plain arrays in {source.name!r}, got: {error}; convert it as docs/models.md shows"
        ) from error
    vertices, shapes = len(arrays["v_template"]), arrays["shapedirs"].shape
    if arrays["weights"].shape != (vertices, FLAME_JOINTS) or shapes[:2] != (vertices, 3) or shapes[2] <= FLAME_SHAPES:
        raise BodyFileError(
            f"expected FLAME's weights [V,{FLAME_JOINTS}] and shapedirs [V,3,more than {FLAME_SHAPES}] in "
            f"{source.name!r}, got {arrays['weights'].shape} and {shapes}; give FLAME's own model file"
        )
    return FlameFile(arrays["shapedirs"][:, :, FLAME_SHAPES:])


def _check(name: str, arrays: Mapping[str, NDArray[np.generic]]) -> str:
    """The kind of body, once the sizes agree and the numbers are numbers."""
    vertices, joints = len(arrays["v_template"]), arrays["weights"].shape[-1]
    if joints not in KIND_OF_JOINTS:
        known = ", ".join(f"{count} ({kind})" for count, kind in KIND_OF_JOINTS.items())
        raise BodyFileError(f"expected weights of {known} joints in {name!r}, got {joints}; is it a hand or a head?")
    shapes: dict[str, tuple[int | None, ...]] = {
        "v_template": (vertices, 3),
        "shapedirs": (vertices, 3, None),
        "posedirs": (vertices, 3, 9 * (joints - 1)),
        "J_regressor": (joints, vertices),
        "kintree_table": (2, joints),
        "weights": (vertices, joints),
        "f": (None, 3),
    }
    for key, shape in shapes.items():
        found = arrays[key].shape
        if len(found) != len(shape) or any(want not in (None, got) for want, got in zip(shape, found, strict=True)):
            raise BodyFileError(f"expected {key} {shape} in {name!r}, got {found}; the file is damaged or another body")
        if not np.isfinite(arrays[key].astype(np.float64, copy=False)).all():
            raise BodyFileError(f"expected finite numbers in {key} of {name!r}, got NaN or infinity; fetch it again")
    if int(arrays["f"].max()) >= vertices or int(arrays["f"].min()) < 0:
        raise BodyFileError(f"expected triangles of vertices 0..{vertices - 1} in {name!r}, got {arrays['f'].max()}")
    return KIND_OF_JOINTS[joints]


def _parents(name: str, kintree: NDArray[np.generic]) -> tuple[int, ...]:
    """Parents, the root's -1: files write it as 2^32 - 1, the unsigned form of -1."""
    parents = (-1, *(int(parent) for parent in kintree[0, 1:].tolist()))
    if any(not 0 <= parent < joint for joint, parent in enumerate(parents) if joint):
        raise BodyFileError(f"expected parents before children in kintree_table of {name!r}, got {parents}")
    return parents


def read_obj_uv(path: str | Path, faces: NDArray[np.generic]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Texture coordinates of a `.obj` for a body's triangles.

    Args:
        path: a Wavefront `.obj` of the body's mesh, triangles written `f v/vt ...`, in any order.
        faces: [F,3] the body's triangles, which the file has to hold by vertex number.

    Returns:
        Coordinates [N,2] in [0,1] (origin lower left) and triangles [F,3] into them.

    Raises:
        FileNotFoundError: no such file.
        BodyFileError: no texture coordinates, polygons other than triangles, or the mesh of another body.
    """
    source = Path(path)
    uvs: list[tuple[float, float]] = []
    corners: list[list[tuple[int, int]]] = []
    for line in source.read_text(encoding="utf-8", errors="replace").splitlines():
        tag, *fields = line.split() or [""]
        if tag == "vt":
            uvs.append((float(fields[0]), float(fields[1])))
        elif tag == "f":
            corners.append([_corner(source.name, field) for field in fields])
    if not uvs or not corners or any(len(triangle) != 3 for triangle in corners):
        raise BodyFileError(
            f"expected triangles with texture coordinates in {source.name!r}, got {len(corners)} polygons and "
            f"{len(uvs)} coordinates; take the UV template that the body's makers offer, triangulated"
        )
    of = {vertex_set: dict(triangle) for triangle in corners for vertex_set in [frozenset(v for v, _ in triangle)]}
    wanted = [[int(vertex) for vertex in triangle] for triangle in faces.tolist()]
    missing = sum(frozenset(triangle) not in of for triangle in wanted)
    if missing:
        raise BodyFileError(
            f"expected the body's {len(wanted)} triangles in {source.name!r}, got all but {missing}; it is another mesh"
        )
    uv_faces = np.array([[of[frozenset(t)][vertex] for vertex in t] for t in wanted], dtype=np.int64)
    return np.array(uvs), uv_faces


def _corner(name: str, field: str) -> tuple[int, int]:
    """Zero-based vertex and texture coordinate of `v/vt` or `v/vt/vn`."""
    vertex, _, rest = field.partition("/")
    texture = rest.partition("/")[0]
    if not texture:
        raise BodyFileError(f"expected corners v/vt in {name!r}, got {field!r}; export it with texture coordinates")
    return int(vertex) - 1, int(texture) - 1
