"""Gaussians as `.ply` in the layout of the INRIA 3D Gaussian splatting code, which splat viewers read.

In memory scales and opacities are post-activation and colours are sRGB in [0,1]; in the file scales are logarithms,
opacities logits, and colours the constant term of spherical harmonics, `rgb = 0.5 + C0 * f_dc`. Rotations are wxyz.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ahoy_core.formats.atomic import atomic_path
from ahoy_core.formats.errors import PlyError
from ahoy_core.formats.ply_table import Table, read_table, write_table
from ahoy_core.splat.gaussians import Gaussians

SH_C0 = 0.28209479177387814
# Logarithms and logits have no value for these: scale 0 is stored as 0.1 nm (its square is still a normal float32),
# opacity 0 and 1 as 1e-7 away from the end (far below a display's step, and 1 - 1e-7 is still below 1 in float32).
MIN_SCALE = 1e-10
OPACITY_MARGIN = 1e-7

_POSITION = ("x", "y", "z")
_NORMAL = ("nx", "ny", "nz")
_DC = ("f_dc_0", "f_dc_1", "f_dc_2")
_SCALE = ("scale_0", "scale_1", "scale_2")
_ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")
_REQUIRED = (*_POSITION, *_DC, "opacity", *_SCALE, *_ROTATION)
_REST = "f_rest_"
_SH_COEFFICIENTS = (3, 8, 15)  # beyond the constant one, for degrees 1, 2 and 3


@dataclass(frozen=True)
class GaussianPly:
    """What a `.ply` file holds.

    Attributes:
        gaussians: float32, on the CPU; quaternions of unit length.
        sh_rest: float32 [N,K,3] higher spherical harmonics (K = 3, 8 or 15), None if the file has none.
        extra: further properties by name, [N] each, in the file's order.
        comments: the header's comment lines.
    """

    gaussians: Gaussians
    sh_rest: Tensor | None = None
    extra: Mapping[str, np.ndarray] = field(default_factory=dict)
    comments: tuple[str, ...] = ()


def write_ply(
    path: str | Path,
    gaussians: Gaussians,
    extra: Mapping[str, Tensor | np.ndarray] | None = None,
    comments: Sequence[str] = (),
    sh_rest: Tensor | None = None,
) -> None:
    """Write Gaussians, binary little-endian float32, normals zero.

    Scales below `MIN_SCALE` and opacities within `OPACITY_MARGIN` of 0 and 1 are moved to that bound. Quaternions are
    normalised; a zero quaternion becomes the identity.

    Args:
        path: target; replaced only when the new file is complete.
        gaussians: means [N,3] metres, quats [N,4] wxyz, scales [N,3] metres, opacities [N], colors [N,3] sRGB.
        extra: further values, [N] each, written as float properties after the standard ones (viewers ignore them).
        comments: header comment lines.
        sh_rest: [N,K,3] higher spherical harmonics, K = 3, 8 or 15.

    Raises:
        PlyError: shapes that differ, values that are not finite or out of range, a bad property name or comment.
    """
    values = _checked(gaussians)
    count = len(values["means"])
    inside = values["opacities"].clip(OPACITY_MARGIN, 1 - OPACITY_MARGIN)
    columns: dict[str, np.ndarray] = dict(zip(_POSITION, values["means"].T, strict=True))
    columns |= dict.fromkeys(_NORMAL, np.zeros(count))
    columns |= zip(_DC, (values["colors"].T - 0.5) / SH_C0, strict=True)
    columns |= _rest_columns(sh_rest, count)
    columns["opacity"] = np.log(inside) - np.log1p(-inside)
    columns |= zip(_SCALE, np.log(values["scales"].clip(MIN_SCALE)).T, strict=True)
    columns |= zip(_ROTATION, _unit(values["quats"]).T, strict=True)
    columns |= _extra_columns(extra or {}, columns, count)
    with atomic_path(path) as temporary:
        write_table(temporary, Table(columns, tuple(comments)))


def read_ply(path: str | Path) -> GaussianPly:
    """Read Gaussians from ascii or binary `.ply`, properties in any order, normals and extra properties optional.

    Args:
        path: the file.

    Returns:
        The Gaussians and whatever else the file holds.

    Raises:
        FileNotFoundError: no such file.
        PlyError: malformed or cut off, a property is missing, or values are not finite.
    """
    table = read_table(Path(path))
    columns = table.columns
    missing = [name for name in _REQUIRED if name not in columns]
    if missing:
        raise PlyError(
            f"expected Gaussians with {', '.join(_REQUIRED)}, got {Path(path).name!r} without {', '.join(missing)}: "
            "export it as a 3D Gaussian splatting .ply, not as a mesh or point cloud"
        )
    rest = _rest_from(columns, Path(path).name)
    known = {*_REQUIRED, *_NORMAL, *(name for name in columns if name.startswith(_REST))}
    numbers = {name: columns[name].astype(np.float64) for name in _REQUIRED}
    with np.errstate(over="ignore"):
        scales = np.exp(np.stack([numbers[name] for name in _SCALE], axis=-1)).astype(np.float32)
    broken = ~np.isfinite(scales).all(axis=1) | ~np.isfinite(np.stack(list(numbers.values()))).all(axis=0)
    if broken.any():
        raise PlyError(
            f"expected finite values, got {np.count_nonzero(broken)} broken Gaussians in {Path(path).name!r}"
        )
    gaussians = Gaussians(
        means=_stacked(numbers, _POSITION),
        quats=_float32(_unit(np.stack([numbers[name] for name in _ROTATION], axis=-1))),
        scales=_float32(scales),
        opacities=torch.sigmoid(torch.from_numpy(numbers["opacity"])).float(),
        colors=_float32(0.5 + SH_C0 * np.stack([numbers[name] for name in _DC], axis=-1)),
    )
    extra = {name: values for name, values in columns.items() if name not in known}
    return GaussianPly(gaussians, rest, extra, table.comments)


def _numpy(values: Tensor | np.ndarray) -> np.ndarray:
    array = values.detach().cpu().numpy() if isinstance(values, Tensor) else np.asarray(values)
    return array.astype(np.float64)


def _checked(gaussians: Gaussians) -> dict[str, np.ndarray]:
    count = len(gaussians.means)
    shapes = {
        "means": (count, 3),
        "quats": (count, 4),
        "scales": (count, 3),
        "opacities": (count,),
        "colors": (count, 3),
    }
    values = {name: _numpy(getattr(gaussians, name)) for name in shapes}
    for name, shape in shapes.items():
        _check(name, values[name], shape)
    opacities = values["opacities"]
    if count and (values["scales"].min() < 0 or opacities.min() < 0 or opacities.max() > 1):
        raise PlyError("expected scales >= 0 and opacities in [0,1] (post-activation), got values outside")
    return values


def _check(name: str, array: np.ndarray, shape: tuple[int, ...]) -> None:
    if array.shape != shape:
        raise PlyError(f"expected {name} of shape {list(shape)}, got {list(array.shape)}")
    finite = np.isfinite(array).all(axis=tuple(range(1, array.ndim)))
    if not finite.all():
        raise PlyError(
            f"expected finite {name}, got {np.count_nonzero(~finite)} rows with NaN or infinity: remove them first"
        )


def _unit(quats: np.ndarray) -> np.ndarray:
    # Scaled by the largest entry first, so that tiny quaternions do not underflow when squared.
    largest = np.abs(quats).max(axis=1, keepdims=True, initial=0.0)
    scaled = np.divide(quats, largest, out=np.tile([1.0, 0.0, 0.0, 0.0], (len(quats), 1)), where=largest > 0)
    return scaled / np.linalg.norm(scaled, axis=1, keepdims=True)


def _rest_columns(sh_rest: Tensor | None, count: int) -> dict[str, np.ndarray]:
    if sh_rest is None:
        return {}
    values = _numpy(sh_rest)
    if values.ndim != 3 or values.shape[1] not in _SH_COEFFICIENTS:
        raise PlyError(f"expected sh_rest [N,K,3] with K in {_SH_COEFFICIENTS}, got {list(values.shape)}")
    _check("sh_rest", values, (count, values.shape[1], 3))
    flat = values.transpose(0, 2, 1).reshape(
        count, 3 * values.shape[1]
    )  # the file has all of red, then green, then blue
    return {f"{_REST}{i}": flat[:, i] for i in range(flat.shape[1])}


def _rest_from(columns: Mapping[str, np.ndarray], name: str) -> Tensor | None:
    count = sum(column.startswith(_REST) for column in columns)
    if not count:
        return None
    names = [f"{_REST}{i}" for i in range(count)]
    if count % 3 or count // 3 not in _SH_COEFFICIENTS or any(column not in columns for column in names):
        raise PlyError(f"expected f_rest_0 .. f_rest_{{8, 23 or 44}}, got {count} f_rest properties in {name!r}")
    flat = np.stack([columns[column] for column in names], axis=-1)
    return _float32(flat.reshape(len(flat), 3, count // 3).transpose(0, 2, 1))


def _extra_columns(
    extra: Mapping[str, Tensor | np.ndarray], taken: Mapping[str, np.ndarray], count: int
) -> dict[str, np.ndarray]:
    columns = {}
    for name, values in extra.items():
        if not name.isascii() or not name.isidentifier() or name in taken or name.startswith(_REST):
            raise PlyError(f"expected an unused ASCII identifier as property name, got {name!r}")
        columns[name] = _numpy(values)
        _check(name, columns[name], (count,))
    return columns


def _float32(values: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, np.float32))


def _stacked(columns: Mapping[str, np.ndarray], names: Sequence[str]) -> Tensor:
    return _float32(np.stack([columns[name] for name in names], axis=-1))
